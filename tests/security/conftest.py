"""Certificates and tokens as `liir certs` makes them."""

from pathlib import Path

import pytest

from liir_common.certs import make_certs


@pytest.fixture(scope="session")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a CA, certificates and a token for each role; not to be written to."""
    folder = tmp_path_factory.mktemp("certs")
    make_certs(folder)
    return folder

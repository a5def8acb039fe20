"""docker-compose.yml hands each service the certificates and tokens of its role, and no others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
ROLES = {"learner": "learner", "ray-worker": "actor", "actors": "actor", "evaluator": "evaluator"}


def services() -> dict[str, Any]:
    text = (ROOT / "docker-compose.yml").read_text()
    return yaml.safe_load(text)["services"]  # type: ignore[no-any-return]


def test_a_service_mounts_the_folder_of_its_role_to_read() -> None:
    mounted = {
        name: [volume for volume in service.get("volumes", ()) if volume.startswith("certs")]
        for name, service in services().items()
    }
    made = mounted.pop("certs")
    assert made[0] == "certs:/certs"
    assert {name: volumes for name, volumes in mounted.items() if volumes} == {
        name: [f"certs-{role}:/certs:ro"] for name, role in ROLES.items()
    }
    assert set(made[1:]) == {f"certs-{role}:/certs/{role}" for role in ROLES.values()}


def test_nothing_permits_plaintext_and_ports_are_on_loopback() -> None:
    assert "insecure" not in (ROOT / "docker-compose.yml").read_text().lower()
    published = [str(port) for service in services().values() for port in service.get("ports", ())]
    assert len(published) == 3
    assert all(port.startswith(("127.0.0.1:", "${LEARNER_ADDRESS:-127.0.0.1}:")) for port in published)


def test_a_complete_run_is_known_as_long_as_prometheus_remembers() -> None:
    (kept,) = (word for word in services()["prometheus"]["command"] if "retention" in word)
    assert f"[{kept.partition('=')[2]}]" in (ROOT / "deploy/prometheus/rules.yml").read_text()

"""What fails on the learner's event loop, and where it trains."""

import asyncio

import pytest
import torch

from liir_common.errors import ConfigError
from services.learner.compute.__main__ import device
from services.learner.service import _first_of, _OnLoop


async def fails() -> None:
    await asyncio.sleep(0)
    raise RuntimeError("broken")


def fails_at_once() -> None:
    raise RuntimeError("broken")


@pytest.mark.parametrize("work", [fails, fails_at_once])
def test_work_of_another_thread_that_fails_on_the_loop_ends_the_service(work: object) -> None:
    async def serve() -> None:
        on_loop = _OnLoop(asyncio.get_running_loop())
        await asyncio.to_thread(on_loop, work)
        await asyncio.wait_for(_first_of(asyncio.Event().wait(), on_loop.failure), timeout=10)

    with pytest.raises(RuntimeError, match="broken"):
        asyncio.run(serve())


@pytest.mark.parametrize("gpu", [True, False])
def test_a_gpu_is_taken_where_there_is_one_unless_another_device_is_named(
    monkeypatch: pytest.MonkeyPatch, gpu: bool
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    assert device("auto") == torch.device("cuda" if gpu else "cpu")
    assert device("cpu") == torch.device("cpu")
    if gpu:
        assert device("cuda") == torch.device("cuda")
    else:
        with pytest.raises(ConfigError, match=r"learner\.device: wanted a CUDA device, torch sees none"):
            device("cuda")

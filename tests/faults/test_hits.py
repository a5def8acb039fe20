"""What counts as a fault that hit something: of proxy, processes and clock alone, without the service."""

from __future__ import annotations

import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from tests.e2e.service import wait_for
from tests.faults.proxy import Proxy
from tests.faults.supervisor import Clock, kill


@contextmanager
def connected() -> Iterator[tuple[Proxy, socket.socket, socket.socket]]:
    """A proxy and both ends of a connection through it, over which something came already."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        proxy = Proxy(listener.getsockname()[1])
        try:
            with socket.create_connection(("127.0.0.1", proxy.port)) as near, listener.accept()[0] as far:
                near.sendall(b"x")
                assert far.recv(1) == b"x"
                yield proxy, near, far
        finally:
            proxy.close()


def test_a_cut_hits_a_connection_that_both_ends_hold() -> None:
    with connected() as (proxy, near, _):
        assert proxy.cut()
        with pytest.raises(ConnectionResetError):
            near.recv(1)
        assert not proxy.cut()


def test_a_stall_hits_what_is_sent_and_no_link_that_is_stalled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.faults.proxy._TRAFFIC_S", 0.1)
    with connected() as (proxy, near, far):
        assert not proxy.stall(60), "nothing was sent"
        wait_for(proxy._flowing.is_set, "the end of a stall of nothing")
        threading.Timer(0.05, near.sendall, [b"y"]).start()
        monkeypatch.setattr("tests.faults.proxy._TRAFFIC_S", 60.0)
        assert proxy.stall(2)
        assert not proxy.stall(2), "it is stalled already"
        assert far.recv(1) == b"y"


def test_a_delay_hits_what_is_sent() -> None:
    with connected() as (proxy, near, far):
        assert not proxy.slow(0.01, seconds=0.0)
        threading.Timer(0.05, near.sendall, [b"y"]).start()
        assert proxy.slow(0.01, seconds=2.0)
        assert far.recv(1) == b"y"


def test_a_kill_hits_no_zombie() -> None:
    process = subprocess.Popen(["sleep", "60"])
    victim = psutil.Process(process.pid)
    assert kill(victim)
    wait_for(lambda: victim.status() == psutil.STATUS_ZOMBIE, "the zombie")
    assert not kill(victim)
    process.wait()
    assert not kill(victim)


@pytest.mark.faults  # wants a compiler
def test_a_clock_rules_who_was_started_with_it(tmp_path: Path) -> None:
    clock = Clock(tmp_path, "sleeper")
    assert not clock.rules(psutil.Process())
    process = subprocess.Popen(["sleep", "60"], env=clock.environment)
    try:
        wait_for(lambda: clock.rules(psutil.Process(process.pid)), "the process's reading the clock")
    finally:
        process.kill()
        process.wait()

"""Rules, alerts and dashboard against the real Prometheus, which scrapes a real training."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from liir_common.client import CheckpointClient
from liir_common.errors import LiirError
from tests.e2e import service
from tests.unit.test_metrics import DASHBOARD, check_described, defined

pytestmark = pytest.mark.prometheus

CONFIG = Path(__file__).parents[2] / "deploy/prometheus"
OF_PROMETHEUS = re.compile("up$|scrape_|ALERTS|liir:")
"""Series that it adds itself, of every scrape and of the rules."""


def program(name: str) -> str:
    """Path of a program of the prometheus package."""
    path = shutil.which(name)
    assert path, (
        f"{name} is not on the PATH; make test-monitoring gets it from Debian's package of Prometheus"
    )
    return path


def test_configuration_is_valid_and_alerts_fire_when_they_should() -> None:
    for arguments in (("check", "config", "prometheus.yml"), ("test", "rules", "rules_test.yml")):
        done = subprocess.run([program("promtool"), *arguments], cwd=CONFIG, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


def test_every_alert_has_a_case_in_which_it_fires() -> None:
    (group,) = yaml.safe_load((CONFIG / "rules.yml").read_text())["groups"]
    cases = yaml.safe_load((CONFIG / "rules_test.yml").read_text())["tests"]
    fired = {
        case["alertname"] for test in cases for case in test.get("alert_rule_test", ()) if case["exp_alerts"]
    }
    assert fired == {rule["alert"] for rule in group["rules"] if "alert" in rule}


def metrics_addresses(run_dir: Path) -> dict[str, str]:
    """HOST:PORT of each process's /metrics, by scrape job, from the processes' logs."""
    out = {}
    for job in ("learner", "actors", "evaluator"):
        log = run_dir / "logs" / f"{job}.log"
        service.wait_for(lambda log=log: "serving metrics" in log.read_text(), f"the metrics of {job}")  # type: ignore[misc]
        lines = [json.loads(line) for line in log.read_text().splitlines() if line.startswith("{")]
        url = next(line["url"] for line in lines if line["event"] == "serving metrics")
        out[job] = urllib.parse.urlsplit(url).netloc
    return out


@contextmanager
def prometheus(folder: Path, addresses: dict[str, str]) -> Iterator[str]:
    """The deployed configuration with other addresses and a quicker pulse; yields its URL."""
    config = yaml.safe_load((CONFIG / "prometheus.yml").read_text())
    config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
    config["rule_files"] = [str(CONFIG / name) for name in config["rule_files"]]
    config["scrape_configs"] = [
        scrape | {"static_configs": [{"targets": [addresses[scrape["job_name"]]]}]}
        for scrape in config["scrape_configs"]
        if scrape["job_name"] in addresses
    ]
    (folder / "prometheus.yml").write_text(yaml.safe_dump(config))
    port = service.free_port()
    arguments = [
        program("prometheus"),
        f"--config.file={folder / 'prometheus.yml'}",
        f"--storage.tsdb.path={folder / 'data'}",
        f"--web.listen-address=127.0.0.1:{port}",
    ]
    with (folder / "prometheus.log").open("wb") as log:
        process = subprocess.Popen(arguments, stdout=log, stderr=log)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(30)


def ask(url: str, path: str, **parameters: str) -> Any:
    """One call of Prometheus' HTTP interface."""
    with urllib.request.urlopen(
        f"{url}/api/v1/{path}?{urllib.parse.urlencode(parameters)}", timeout=10
    ) as page:
        return json.load(page)["data"]


def lines(url: str, expression: str, begin: float) -> list[list[float]]:
    """What Grafana gets for a panel of the time since `begin`: the values of each line.

    Twice between two scrapes, so that there are figures that repeat.
    """
    end = time.time()
    variables = {"$__rate_interval": "10s", "$__interval": "500ms", "$__range": f"{end - begin:.0f}s"}
    for name, value in variables.items():
        expression = expression.replace(name, value)
    data = ask(url, "query_range", query=expression, start=str(begin), end=str(end), step="0.5")
    return [[float(value) for _, value in line["values"]] for line in data["result"]]


def is_drawn(url: str, expression: str, begin: float) -> bool:
    """Whether a panel has a point to draw."""
    return any(math.isfinite(value) for line in lines(url, expression, begin) for value in line)


def check_ascends(url: str, expression: str, begin: float) -> None:
    """What a trend panel demands of its x axis, once three checkpoints have been tested."""

    def values() -> list[float]:
        return lines(url, expression, begin)[0]

    service.wait_for(lambda: len(set(values())) >= 3, "three tested checkpoints")
    assert (steps := values()) == sorted(set(steps))


def test_every_panel_draws_a_real_training(tmp_path: Path) -> None:
    run_dir, begin = tmp_path / "run", time.time()
    panels = json.loads(DASHBOARD.read_text())["panels"]
    expressions = {target["expr"] for panel in panels for target in panel.get("targets", ())}
    (steps,) = (panel["targets"][0]["expr"] for panel in panels if panel["type"] == "trend")
    with service.training(run_dir, "training.total_env_steps=10000000", "learner.threads=1"):
        service.wait_for(lambda: service.learner_step(run_dir) >= 3, "the third learner step")
        addresses = metrics_addresses(run_dir)
        with prometheus(tmp_path, addresses) as url:
            refuse_a_call(run_dir)
            deadline = time.monotonic() + 60
            empty = set(expressions)
            while empty and time.monotonic() < deadline:
                time.sleep(2)
                empty = {expression for expression in empty if not is_drawn(url, expression, begin)}
            assert not empty
            check_ascends(url, steps, begin)
            twice = "count by (__name__) (count by (__name__, job) ({__name__=~'liir_.*'})) > 1"
            assert ask(url, "query", query=twice)["result"] == []
            names = set(ask(url, "label/__name__/values"))
            for job, address in addresses.items():
                check_described(job, service.page(f"http://{address}/metrics"))
            assert ask(url, "query", query='ALERTS{alertstate="firing"}')["result"] == []
    assert {name for name in names if not OF_PROMETHEUS.match(name)} == series()


def series() -> set[str]:
    """Names in Prometheus of all that is defined, and drawn."""
    histograms = {name for name, (kind, *_) in defined().items() if kind == "histogram"}
    parts = {f"{name}_{part}" for name in histograms for part in ("bucket", "sum", "count")}
    return set(defined()) - histograms | parts


def refuse_a_call(run_dir: Path) -> None:
    """An error for the panel of errors."""
    with (
        CheckpointClient(service.endpoints(run_dir)["address"]) as client,
        pytest.raises(LiirError, match="no checkpoint of episode 7"),
    ):
        client.download(7)

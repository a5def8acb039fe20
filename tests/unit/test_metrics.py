"""Every metric is described in docs/metrics.md, drawn in the dashboard, and nothing else is."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from prometheus_client import REGISTRY, Counter, Metric, generate_latest
from prometheus_client.metrics import MetricWrapperBase
from prometheus_client.parser import text_string_to_metric_families

from liir_common import metrics

ROOT = Path(__file__).parents[2]
DASHBOARD = ROOT / "deploy/grafana/dashboards/liir.json"
RULES = ROOT / "deploy/prometheus/rules.yml"
NAME = re.compile(r"\b(?:liir|compute|process|python)_\w+")
UNIT_SUFFIXES = {
    "seconds": "s",
    "bytes": "bytes",
    "steps": "steps",
    "versions": "versions",
    "fds": "descriptors",
}
SECTIONS = {
    "learner": "Learner, port 9101",
    "actors": "Actor driver, port 9102",
    "evaluator": "Evaluator, port 9103",
}
"""Scrape job → heading of docs/metrics.md."""
REGISTRIES = {"learner": metrics.LEARNER, "actors": metrics.DRIVER, "evaluator": metrics.EVALUATOR}


def full_name(family: Metric) -> str:
    """As its samples have it."""
    return family.name + ("_total" if family.type == "counter" else "")


def defined() -> dict[str, tuple[str, str, str]]:
    """Name → (type, labels, help) of every metric of the service."""
    out = {}
    for metric in vars(metrics).values():
        if isinstance(metric, MetricWrapperBase):
            (family,) = metric.describe()
            out[full_name(family)] = (family.type, ", ".join(metric._labelnames) or "–", family.documentation)
    for prefix in ("", "compute"):
        for family in metrics.ProcessMetrics(prefix, registry=None).collect():
            out[full_name(family)] = (family.type, "–", family.documentation)
    return out


def documented(section: str = "") -> dict[str, tuple[str, str, str, str]]:
    """Name → (type, labels, unit, meaning) of the rows of docs/metrics.md, or of one of its sections."""
    text = (ROOT / "docs/metrics.md").read_text()
    if section:
        text = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \| (.*?) \| (.*?) \| (.*?) \|$", text, re.M)
    return {name: tuple(rest) for name, *rest in rows}  # type: ignore[misc]


def check_described(job: str, page: str) -> None:
    """A process's /metrics page has what its section of the document has, and what every process has."""
    families = {full_name(family): family.documentation for family in text_string_to_metric_families(page)}
    rows = documented("Every process") | documented(SECTIONS[job])
    assert families == {name: meaning for name, (_, _, _, meaning) in rows.items()}


def rules() -> list[dict[str, str]]:
    """Recorded figures and alerts."""
    (group,) = yaml.safe_load(RULES.read_text())["groups"]
    return group["rules"]  # type: ignore[no-any-return]


def drawn() -> set[str]:
    """Names of the metrics behind the dashboard's expressions, recorded figures resolved."""
    recorded = {rule["record"]: rule["expr"] for rule in rules() if "record" in rule}
    names: set[str] = set()
    for panel in json.loads(DASHBOARD.read_text())["panels"]:
        for target in panel.get("targets", ()):
            expression = target["expr"]
            for record in re.findall(r"liir:[\w:]+", expression):
                expression += recorded[record]
            names |= set(NAME.findall(expression))
    return {re.sub("_(bucket|sum|count)$", "", name) for name in names}


def test_the_document_has_a_row_for_every_metric_and_no_other() -> None:
    rows = {name: (kind, labels, text) for name, (kind, labels, _, text) in documented().items()}
    assert rows == defined()


def test_units_are_given_and_agree_with_the_names() -> None:
    for name, (_, _, unit, _) in documented().items():
        assert unit, name
        suffix = name.removesuffix("_total").rpartition("_")[2]
        assert unit == UNIT_SUFFIXES.get(suffix, unit), name


def test_every_metric_is_drawn_and_everything_drawn_exists() -> None:
    assert drawn() == set(defined())


@pytest.mark.parametrize("job", SECTIONS)
def test_a_process_exposes_what_is_described_and_no_more(job: str) -> None:
    counter = Counter("liir_of_a_library", "In the default registry, which is not exposed")
    try:
        with metrics.process_exposed(REGISTRIES["learner"], "compute", os.getpid()):
            check_described(job, generate_latest(REGISTRIES[job]).decode())
    finally:
        REGISTRY.unregister(counter)


def test_a_metric_without_a_row_is_noticed() -> None:
    page = generate_latest(metrics.DRIVER).decode()
    with pytest.raises(AssertionError):
        check_described(
            "actors", page + "# HELP process_max_fds Most.\n# TYPE process_max_fds gauge\nprocess_max_fds 1\n"
        )


def test_the_win_rates_of_the_trend_have_names_and_alone_end_at_one() -> None:
    (trend,) = (panel for panel in json.loads(DASHBOARD.read_text())["panels"] if panel["type"] == "trend")
    assert trend["options"]["legend"]["showLegend"]
    assert "max" not in trend["fieldConfig"]["defaults"]  # which would be that of its x axis, too
    (override,) = trend["fieldConfig"]["overrides"]
    assert {"id": "max", "value": 1} in override["properties"]
    matches = re.compile(override["matcher"]["options"].strip("/")).search
    assert not matches(trend["options"]["xField"])
    assert all(map(matches, ("3m greedy", "3m sampled")))


def test_another_process_can_be_exposed_beside_the_own() -> None:
    registry = metrics.ProcessRegistry()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        with metrics.process_exposed(registry, "compute", other.pid):
            # Of a process that has only begun it may still be 0.
            assert registry.get_sample_value("compute_process_resident_memory_bytes", {}) is not None
        assert registry.get_sample_value("compute_process_resident_memory_bytes", {}) is None


def test_alerts_watch_metrics_that_exist() -> None:
    for rule in rules():
        names = {re.sub("_(bucket|sum|count)$", "", name) for name in NAME.findall(rule["expr"])}
        assert names <= set(defined()), rule


def test_the_dashboard_is_what_its_program_writes() -> None:
    program = ROOT / "deploy/grafana/dashboard.py"
    written = subprocess.run([sys.executable, str(program)], check=True, capture_output=True, text=True)
    assert DASHBOARD.read_text() == written.stdout, "run make dashboard"

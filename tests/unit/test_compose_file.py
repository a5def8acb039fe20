"""docker-compose.yml hands each service the certificates, tokens and files that are its own."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml
from ray._private import ray_constants

ROOT = Path(__file__).parents[2]
ROLES = {
    "learner": "learner",
    "ray-head": "actor",
    "ray-worker": "actor",
    "actors": "actor",
    "evaluator": "evaluator",
}
OURS = {"certs", "learner", "ray-head", "ray-worker", "actors", "evaluator"}
OTHERS = {"prometheus", "grafana"}
DRAIN = "RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S"
COMPLETE, HEALTHY = "service_completed_successfully", "service_healthy"


def composed() -> dict[str, Any]:
    return yaml.safe_load((ROOT / "docker-compose.yml").read_text())  # type: ignore[no-any-return]


def services() -> dict[str, Any]:
    return composed()["services"]  # type: ignore[no-any-return]


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


def test_compiled_code_is_shared_within_a_role_only() -> None:
    mounted = {
        name: [volume for volume in service.get("volumes", ()) if volume.endswith(":/kernels")]
        for name, service in services().items()
    }
    assert {name: volumes for name, volumes in mounted.items() if volumes} == {
        name: [f"kernels-{role}:/kernels"] for name, role in ROLES.items()
    }


def test_a_ray_node_does_not_wait_for_its_actors_when_it_is_to_end() -> None:
    assert hasattr(ray_constants, DRAIN), "Ray calls it something else now"
    nodes = [service for service in services().values() if "ray start" in service.get("command", "")]
    assert [service["environment"][DRAIN] for service in nodes] == [0, 0, 0]


def test_every_ray_node_has_the_token_of_the_others() -> None:
    nodes = [service for service in services().values() if "ray start" in service.get("command", "")]
    wanted = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": "/certs/ray-token"}
    assert [wanted.items() <= service["environment"].items() for service in nodes] == [True] * 3


def test_what_runs_on_has_a_health_check_and_is_started_again() -> None:
    assert services().keys() == OURS | OTHERS
    assert [name for name, service in services().items() if "healthcheck" not in service] == ["certs"]
    restarts = {name: service.get("restart") for name, service in services().items()}
    assert restarts == dict.fromkeys(OURS | OTHERS, "unless-stopped") | {"certs": None}


@pytest.mark.parametrize("name", sorted(OURS))
def test_ours_can_do_no_more_than_they_must_and_get_time_to_end(name: str) -> None:
    service = services()[name]
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert not {"cap_add", "privileged", "user"} & service.keys()
    # Docker's own ten seconds are too few on a loaded machine; the learner saves its state in them, too.
    assert service["stop_grace_period"] == ("60s" if name == "learner" else "20s")


def test_what_is_written_lies_in_named_volumes() -> None:
    mounts = [mount.split(":") for service in services().values() for mount in service.get("volumes", ())]
    written = {source for source, _, *options in mounts if options != ["ro"]}
    assert written == composed()["volumes"].keys()
    assert "runs:/runs" in services()["learner"]["volumes"]
    assert "--run-dir /runs/" in services()["learner"]["command"]


def test_each_starts_when_what_it_needs_is_there() -> None:
    conditions = {
        name: {needed: how["condition"] for needed, how in service.get("depends_on", {}).items()}
        for name, service in services().items()
    }
    assert conditions == {
        "certs": {},
        "learner": {"certs": COMPLETE},
        "ray-head": {"certs": COMPLETE},
        "ray-worker": {"certs": COMPLETE, "ray-head": HEALTHY},
        "actors": {"learner": HEALTHY, "ray-worker": HEALTHY},
        "evaluator": {"learner": HEALTHY, "actors": HEALTHY},
        "prometheus": {},
        "grafana": {"prometheus": HEALTHY},
    }


def test_nothing_permits_plaintext_and_ports_are_on_loopback() -> None:
    assert "insecure" not in (ROOT / "docker-compose.yml").read_text().lower()
    published = [str(port) for service in services().values() for port in service.get("ports", ())]
    assert len(published) == 3
    assert all(port.startswith(("127.0.0.1:", "${LEARNER_ADDRESS:-127.0.0.1}:")) for port in published)


def test_who_watches_is_needed_by_nobody_and_keeps_its_data() -> None:
    watchers = {"prometheus": "/prometheus", "grafana": "/var/lib/grafana"}
    assert watchers.keys() == OTHERS
    for name, service in services().items():
        if name not in watchers:
            assert not watchers.keys() & service.get("depends_on", {}).keys()
    for name, folder in watchers.items():
        assert services()[name]["restart"] == "unless-stopped"
        assert f"{name}:{folder}" in services()[name]["volumes"]


def test_grafana_finds_its_dashboard_and_the_dashboard_its_data() -> None:
    grafana = services()["grafana"]
    mounted = {at: ROOT / folder for folder, at, *_ in (line.split(":") for line in grafana["volumes"])}
    provisioning = mounted["/etc/grafana/provisioning"]
    (provider,) = yaml.safe_load((provisioning / "dashboards/liir.yml").read_text())["providers"]
    home = PurePosixPath(grafana["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"])
    assert str(home.parent) == provider["options"]["path"]
    panels = json.loads((mounted[str(home.parent)] / home.name).read_text())["panels"]
    (source,) = yaml.safe_load((provisioning / "datasources/prometheus.yml").read_text())["datasources"]
    queries = [query for panel in panels for query in [panel, *panel.get("targets", ())]]
    assert {query["datasource"]["uid"] for query in queries if "datasource" in query} == {source["uid"]}
    assert urlsplit(source["url"]).hostname in services()

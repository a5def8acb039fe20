"""docker-compose.yml hands each service the certificates, tokens and files that are its own."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlsplit

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
DRAIN = "RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S"


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


def test_what_runs_on_has_a_health_check() -> None:
    assert [name for name, service in services().items() if "healthcheck" not in service] == ["certs"]


def test_nothing_permits_plaintext_and_ports_are_on_loopback() -> None:
    assert "insecure" not in (ROOT / "docker-compose.yml").read_text().lower()
    published = [str(port) for service in services().values() for port in service.get("ports", ())]
    assert len(published) == 3
    assert all(port.startswith(("127.0.0.1:", "${LEARNER_ADDRESS:-127.0.0.1}:")) for port in published)


def test_who_watches_is_needed_by_nobody_and_keeps_its_data() -> None:
    watchers = {"prometheus": "/prometheus", "grafana": "/var/lib/grafana"}
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

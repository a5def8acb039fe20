"""The files of deploy/ for clusters are what Ray and Kubernetes read."""

from __future__ import annotations

import copy
import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import kubernetes_validate
import pytest
import ray
import yaml

DEPLOY = Path(__file__).parents[2] / "deploy"
RAY_SCHEMA = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())
CLUSTERS = ("cluster.yaml", "cluster.aws.yaml")
KUBERNETES = "1.33"

# KubeRay publishes its schemas with the operator and not as a package: these are the parts in use, after the
# types of its API ray.io/v1. The pods in them have Kubernetes' own schema.
TEXTS = {"type": "object", "additionalProperties": {"type": "string"}}
COUNT = {"type": "integer", "minimum": 0}
POD = {"type": "object"}


def closed(properties: dict[str, Any], *required: str) -> dict[str, Any]:
    """Schema of an object with these properties and no others."""
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


WORKERS = closed(
    {
        "groupName": {"type": "string"},
        "replicas": COUNT,
        "minReplicas": COUNT,
        "maxReplicas": COUNT,
        "rayStartParams": TEXTS,
        "template": POD,
    },
    *("groupName", "maxReplicas", "minReplicas", "template"),
)
RAY_JOB = closed(
    {
        "apiVersion": {"const": "ray.io/v1"},
        "kind": {"const": "RayJob"},
        "metadata": closed({"name": {"type": "string"}}, "name"),
        "spec": closed(
            {
                "entrypoint": {"type": "string"},
                "backoffLimit": COUNT,
                "shutdownAfterJobFinishes": {"type": "boolean"},
                "rayClusterSpec": closed(
                    {
                        "rayVersion": {"type": "string"},
                        "authOptions": closed({"mode": {"enum": ["disabled", "token"]}}),
                        "headGroupSpec": closed({"rayStartParams": TEXTS, "template": POD}, "template"),
                        "workerGroupSpecs": {"type": "array", "items": WORKERS},
                    },
                    "headGroupSpec",
                ),
            },
        ),
    },
    *("apiVersion", "kind", "metadata", "spec"),
)


def read(name: str) -> Any:
    return yaml.safe_load((DEPLOY / name).read_text())


def kubernetes_objects() -> list[Any]:
    return list(yaml.safe_load_all((DEPLOY / "kuberay.yaml").read_text()))


def check_ray_job(job: dict[str, Any]) -> None:
    """Raise jsonschema.ValidationError unless KubeRay and Kubernetes take it."""
    jsonschema.validate(job, RAY_JOB)
    cluster = job["spec"]["rayClusterSpec"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        template = {"apiVersion": "v1", "kind": "PodTemplate", "metadata": {"name": "pod"}}
        kubernetes_validate.validate(template | {"template": group["template"]}, KUBERNETES, strict=True)


@pytest.fixture
def job() -> dict[str, Any]:
    """The RayJob of kuberay.yaml."""
    (job,) = (
        part for part in yaml.safe_load_all((DEPLOY / "kuberay.yaml").read_text()) if part["kind"] == "RayJob"
    )
    return copy.deepcopy(job)  # what YAML aliases share is one object


@pytest.mark.parametrize("name", CLUSTERS)
def test_a_cluster_file_is_what_ray_reads(name: str) -> None:
    jsonschema.validate(read(name), RAY_SCHEMA)


def test_the_schema_finds_what_ray_does_not_know() -> None:
    with pytest.raises(jsonschema.ValidationError, match="workers_ips"):
        jsonschema.validate(read("cluster.yaml") | {"workers_ips": []}, RAY_SCHEMA)
    with pytest.raises(jsonschema.ValidationError, match="not of type 'array'"):
        jsonschema.validate(read("cluster.yaml") | {"setup_commands": "make"}, RAY_SCHEMA)


@pytest.mark.parametrize("name", CLUSTERS)
def test_what_a_cluster_file_sends_and_runs_exists(name: str) -> None:
    cluster = read(name)
    sent = cluster["file_mounts"] | {"~/.ray/auth_token": "deploy"}  # the user makes that
    for there, here in sent.items():
        assert (DEPLOY.parent / here).exists(), f"{there}: {here}"
    for key, commands in cluster.items():
        for command in commands if key.endswith("_commands") else ():
            subprocess.run(["bash", "-n", "-c", command], check=True)


def test_both_clusters_set_up_the_same() -> None:
    ours, aws = map(read, CLUSTERS)
    for key in ("rsync_exclude", "worker_start_ray_commands"):
        assert ours[key] == aws[key]
    only_there = aws["file_mounts"].items() - ours["file_mounts"].items()
    assert {here for _, here in only_there} == {"deploy/requirements-aws.txt", "deploy/requirements-uv.txt"}
    assert ours["file_mounts"].items() < aws["file_mounts"].items()
    assert ours["setup_commands"][0] == aws["setup_commands"][0]
    assert ours["setup_commands"][2:] == aws["setup_commands"][2:]


def test_the_aws_head_and_counts_are_consistent() -> None:
    aws = read("cluster.aws.yaml")
    types = aws["available_node_types"]
    assert aws["head_node_type"] in types
    assert aws["max_workers"] == sum(node.get("max_workers", 0) for node in types.values())


def test_kubernetes_takes_every_object(job: dict[str, Any]) -> None:
    check_ray_job(job)
    for part in kubernetes_objects():
        if part["kind"] != "RayJob":
            kubernetes_validate.validate(part, KUBERNETES, strict=True)


DAMAGES: dict[str, Callable[[dict[str, Any], dict[str, Any]], object]] = {
    "imagePullPolice": lambda spec, head: head["template"]["spec"]["containers"][0].update(
        imagePullPolice=""
    ),
    "is not of type 'string'": lambda spec, head: head["rayStartParams"].update({"num-cpus": 0}),
    "rayCluster'": lambda spec, head: spec.update(rayCluster={}),
    "'template' is a required property": lambda spec, head: head.pop("template"),
}


@pytest.mark.parametrize("message", DAMAGES)
def test_a_damaged_ray_job_is_found(message: str, job: dict[str, Any]) -> None:
    DAMAGES[message](job["spec"], job["spec"]["rayClusterSpec"]["headGroupSpec"])
    with pytest.raises(jsonschema.ValidationError, match=message):
        check_ray_job(job)


def test_every_pod_can_write_where_the_run_is(job: dict[str, Any]) -> None:
    run_folder = re.search(r"cd (\S+)", job["spec"]["entrypoint"])
    assert run_folder
    cluster = job["spec"]["rayClusterSpec"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        (container,) = group["template"]["spec"]["containers"]
        assert run_folder[1] in [mount["mountPath"] for mount in container["volumeMounts"]]


def test_no_pod_waits_for_its_actors_when_it_is_to_end(job: dict[str, Any]) -> None:
    cluster = job["spec"]["rayClusterSpec"]
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        (container,) = group["template"]["spec"]["containers"]
        assert {"name": "RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S", "value": "0"} in container["env"]


def test_kubernetes_runs_the_ray_that_is_installed(job: dict[str, Any]) -> None:
    assert job["spec"]["rayClusterSpec"]["rayVersion"] == ray.__version__


def test_ray_on_kubernetes_wants_a_token(job: dict[str, Any]) -> None:
    assert job["spec"]["rayClusterSpec"]["authOptions"] == {"mode": "token"}

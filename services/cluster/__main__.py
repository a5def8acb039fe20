"""`liir train` on a Ray cluster: the learner on a GPU if there is one, the actors on every node."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import ray
import yaml

from liir_common import launch, logs, options
from liir_common.certs import make_certs
from liir_common.config import PLAINTEXT, ActorsConfig, SecurityConfig, holds_run
from liir_common.errors import LiirError, exit_on_error
from liir_common.rpc import carry
from liir_common.rpc.tokens import Role
from services.actor.driver import start_ray
from services.cluster.host import RemoteService

_ANYWHERE = {"num_cpus": 0.001, "scheduling_strategy": "SPREAD"}
"""As an actor: of nodes with CPUs, some node."""


def train(
    config: options.ConfigFile = None,
    settings: options.Settings = None,
    run_dir: options.RunDir = None,
    resume: options.Resume = False,
    resume_if_begun: options.ResumeIfBegun = False,
) -> None:
    """Train on the Ray cluster that this machine is the head of."""
    logs.configure("train")
    resume = resume or (resume_if_begun and run_dir is not None and holds_run(run_dir))
    with exit_on_error():
        start_ray(ActorsConfig(ray_address="auto"))
        command = "ray submit deploy/cluster.yaml deploy/train.py --"
        launch.train(command, on_cluster, config, settings or (), run_dir, resume)


def on_cluster(request: launch.Request) -> launch.Launcher:
    """A launcher of processes all over the cluster; this one must be joined already.

    Raises:
        LiirError: the run to resume is on a node that is not there.
        ConfigError: certificates cannot be made, or a file of `security` cannot be read.
    """
    run_dir = request.run_dir.absolute()
    nodes = {node["NodeManagerAddress"]: node["Resources"] for node in ray.nodes() if node["Alive"]}
    learner = Learner(request, run_dir, learners_place(request, nodes))
    address = learner.settle()
    security = roles_security(request, Path("certs", run_dir.name).absolute(), address)
    learner.arguments += ["--set", f"learner.host={address}"]
    learner.files = carry.pack(security["learner"])
    evaluator = RemoteService("evaluator", [], run_dir, _ANYWHERE)
    evaluator.files = carry.pack(security[Role.EVALUATOR], Role.EVALUATOR)
    actor = launch.as_settings(security[Role.ACTOR])
    ray_settings = ["--set", "actors.ray_address=auto", "--set", "actors.send_security=true"]
    actors = launch.LocalService("actor", [*actor, *ray_settings], run_dir, "actors")
    return launch.Launcher(run_dir, learner, actors, evaluator, security[Role.OPERATOR])


class Learner(RemoteService):
    """The learner, whose run directory can be looked into and resumed from here."""

    brought = "**/*"

    def __init__(self, request: launch.Request, run_dir: Path, place: Mapping[str, Any]) -> None:
        """Prepare what was asked for, on a node that fits `place`."""
        arguments = ["--run-dir", str(run_dir), *(["--resume"] if request.resume else [])]
        arguments += [part for setting in request.settings for part in ("--set", setting)]
        # With what the environment here says; the names of files here mean nothing there.
        tree = b"" if request.resume else yaml.safe_dump(request.config.shared_tree()).encode()
        super().__init__("learner", arguments, run_dir, place, tree)

    def address(self) -> str | None:
        """Where it serves, once it does; by then the run says so here, too."""
        address = super().address()
        if address:
            self.fetch("*.*")
        return address


def learners_place(request: launch.Request, nodes: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Options of the Ray actor that holds the learner; `nodes` are resources by address.

    A new run takes a GPU, or else the head. A resumed one goes where its directory is, which is also the head
    if the directory was brought there, or the head has another address now.

    Raises:
        LiirError: the directory is on a node that is not there.
    """
    endpoints = request.run_dir / "endpoints.json"
    if request.resume and endpoints.exists():  # not if it is restored from a backup, or never served
        address = json.loads(endpoints.read_text())["address"].rpartition(":")[0]
        if address in nodes:
            return _on(f"node:{address}", nodes)
        # Which is not among what is copied here at the start.
        if not (request.run_dir / "state").exists():
            raise LiirError(
                f"{request.run_dir} is on the disk of {address}, and only {', '.join(nodes)} are in the "
                "cluster; bring it back, or copy the run directory to the head"
            )
    gpu = request.config.learner.device != "cpu" and any(node.get("GPU") for node in nodes.values())
    if gpu and not request.resume:
        return {"num_cpus": 0, "num_gpus": 1}
    return _on("node:__internal_head__", nodes)


def _on(resource: str, nodes: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Options for the node that has this resource, with a GPU of it if there is one."""
    gpus = next((node.get("GPU", 0) for node in nodes.values() if resource in node), 0)
    return {"num_cpus": 0, "num_gpus": min(1, gpus), "resources": {resource: 0.001}}


def roles_security(request: launch.Request, folder: Path, address: str) -> dict[str, SecurityConfig]:
    """The section `security` of the learner at `address` and of each role: as it is configured, or made now.

    What is made stays in `folder`; made again, the CA and the tokens are the same.
    """
    roles = ("learner", *Role)
    # Of a resumed run, too, this is what is said now: where its own section points to may be gone.
    configured = options.load_security(request.file, list(request.settings))
    if configured != PLAINTEXT or request.config.learner.insecure:
        return dict.fromkeys(roles, configured)
    make_certs(folder, [address])
    return {role: SecurityConfig.of(folder / role) for role in roles}


if __name__ == "__main__":
    options.run(train)

"""Nothing in our sources turns data into code."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Tests may copy what they made themselves, as users of an environment do.
FOLDERS = ("liir_common", "services", "deploy")
SOURCES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
SERIALISERS = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "multiprocessing"}
LOADERS = {"torch.load", "torch.jit.load", "yaml.load", "yaml.load_all"}
"""To be called by their full names, by which they are found."""
RUNNERS = {"eval", "exec", "os.system", "os.popen", "__import__"}
RUNNERS |= {f"yaml.{kind}_load{all_}" for kind in ("unsafe", "full") for all_ in ("", "_all")}
SAFE_LOADERS = {"SafeLoader", "CSafeLoader"}


def dangers(source: str) -> Iterator[str]:
    """What in a source could run what it reads, as text."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            yield from (name for name in names if name.split(".")[0] in SERIALISERS)
            yield from {f"{names[-1]}.{name}" for name in names} & (LOADERS | RUNNERS)
        elif isinstance(node, ast.Call):
            yield from dangerous_call(node)


def dangerous_call(node: ast.Call) -> Iterator[str]:
    called = ast.unparse(node.func)
    keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
    arguments = {ast.unparse(argument).rpartition(".")[2] for argument in node.args}
    if called.removeprefix("builtins.") in RUNNERS or called.endswith(".read_pickle"):
        yield called
    if called == "torch.load" and keywords.get("weights_only") != "True":
        yield called
    if called in ("yaml.load", "yaml.load_all") and not SAFE_LOADERS & {
        *arguments,
        keywords.get("Loader", "").rpartition(".")[2],
    }:
        yield called
    if keywords.get("shell", "False") != "False":
        yield f"{called}(shell=…)"
    if keywords.get("weights_only", "True") != "True" or keywords.get("allow_pickle", "False") != "False":
        yield f"{called}(pickles)"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_source_runs_what_it_reads(path: Path) -> None:
    assert not list(dangers(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from multiprocessing import Pipe",
        "from pickle import loads",
        "import os, ray.cloudpickle, cloudpickle.x",
        "eval(text)",
        "builtins.exec(text)",
        "from yaml import unsafe_load",
        "from torch import load as read",
        "yaml.load_all(text)",
        "yaml.full_load_all(text)",
        "pandas.read_pickle(file)",
        "torch.load(file)",
        "torch.load(file, weights_only=False)",
        "yaml.load(text)",
        "yaml.load(text, Loader=yaml.FullLoader)",
        "subprocess.run(command, shell=True)",
        "numpy.load(file, allow_pickle=True)",
    ],
)
def test_the_search_finds(source: str) -> None:
    assert list(dangers(source))


@pytest.mark.parametrize(
    "source",
    [
        "model.eval()",
        "yaml.load(text, yaml.SafeLoader)",
        "from json import load",
        "torch.load(file, weights_only=True)",
        "subprocess.run(command, shell=False)",
    ],
)
def test_the_search_lets_pass(source: str) -> None:
    assert not list(dangers(source))

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
SERIALISERS = {"pickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "multiprocessing"}
LOADERS = {"torch.load", "yaml.load", "yaml.load_all"}
"""Only calls of them can be seen to be safe, so they are not to be imported by themselves."""
RUNNERS = {"eval", "exec", "os.system", "os.popen", "__import__", "torch.jit.load"}
RUNNERS |= {"subprocess.getoutput", "subprocess.getstatusoutput"}
RUNNERS |= {f"yaml.{kind}_load{all_}" for kind in ("unsafe", "full") for all_ in ("", "_all")}
SAFE_LOADERS = {"yaml.SafeLoader", "yaml.CSafeLoader"}


def dangers(source: str) -> Iterator[str]:
    """What in a source could run what it reads, as text."""
    names: dict[str, str] = {}
    calls = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names |= imports(node)
            yield from filter(is_dangerous_import, imports(node).values())
        elif isinstance(node, ast.Call):
            calls.append(node)
    for call in calls:
        yield from dangerous_call(call, names)


def imports(node: ast.Import | ast.ImportFrom) -> dict[str, str]:
    """Name in the source → full name of what it stands for."""
    module = f"{node.module or ''}." if isinstance(node, ast.ImportFrom) else ""
    return {alias.asname or alias.name: module + alias.name for alias in node.names}


def is_dangerous_import(name: str) -> bool:
    return bool(SERIALISERS & set(name.split("."))) or name.removeprefix("builtins.") in LOADERS | RUNNERS


def full_name(node: ast.expr, names: dict[str, str]) -> str:
    """An expression as text, what was imported by the name that it has where it comes from."""
    first, dot, rest = ast.unparse(node).partition(".")
    return (names.get(first, first) + dot + rest).removeprefix("builtins.")


def dangerous_call(node: ast.Call, names: dict[str, str]) -> Iterator[str]:
    called = full_name(node.func, names)
    keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
    arguments = {full_name(value, names) for value in (*node.args, *(word.value for word in node.keywords))}
    if called in RUNNERS or called.endswith(".read_pickle"):
        yield called
    if called == "torch.load" and keywords.get("weights_only") != "True":
        yield called
    if called in ("yaml.load", "yaml.load_all") and not SAFE_LOADERS & arguments:
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
        "import os, ray.cloudpickle",
        "import _pickle",
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
        "subprocess.getoutput(command)",
        "from subprocess import getstatusoutput",
        "from builtins import eval as read",
        "import builtins as b; b.exec(text)",
        "import yaml as y; y.load(text)",
        "import torch as th; th.load(file)",
        "import os as o; o.system(command)",
        "from torch import jit; jit.load(file)",
        "import pandas as p; p.read_pickle(file)",
        "from elsewhere import SafeLoader; yaml.load(text, SafeLoader)",
        "def later():\n y.load(text)\nimport yaml as y",
    ],
)
def test_the_search_finds(source: str) -> None:
    assert list(dangers(source))


@pytest.mark.parametrize(
    "source",
    [
        "model.eval()",
        "yaml.load(text, yaml.SafeLoader)",
        "from yaml import SafeLoader as Safe; import yaml as y; y.load(text, Loader=Safe)",
        "import json as yaml; yaml.load(file)",
        "from json import load",
        "import torch as th; th.load(file, weights_only=True)",
        "subprocess.run(command, shell=False)",
    ],
)
def test_the_search_lets_pass(source: str) -> None:
    assert not list(dangers(source))

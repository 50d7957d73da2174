"""What the documentation shows works, and what it names exists."""

import csv
import doctest
import importlib
import re
import shlex
import shutil
import sys
from itertools import accumulate
from pathlib import Path
from types import ModuleType

import pytest
import torch
from hydra import compose, initialize_config_module
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.report.paper import TABLE_2
from torchrl_mcp.runs import arguments as taken
from torchrl_mcp.runs import build

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
OWN_TESTS = {"character"}
"""Tutorials whose commands write what others need: test_own_character.py."""
TUTORIALS = [
    path
    for path in (DOCS / "index.md", *sorted((DOCS / "guide").glob("*.md")), *sorted((DOCS / "tutorials").glob("*.md")))
    if path.stem not in OWN_TESTS
]
PACKAGES = {"torchrl_mcp": ROOT / "torchrl_mcp", "torchrl_mcp.envs": ROOT / "envs"}

BLOCK = re.compile(r"^```(python|pycon)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
FILE = re.compile(r"^```\{code-block\} \w+\n:caption: (.*?)\n\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SHOWN = re.compile(r"^```\{literalinclude\} (\w[\w./]+)$", re.MULTILINE)
"""Files beside a page that it shows."""
COMMAND = re.compile(r"^(?:PYTHONPATH=\. )?torchrl-mcp-train ((?:.*\\\n)*.*)$", re.MULTILINE)
INCLUDE = re.compile(r"```\{include\} (\S+)\n(.*?)```", re.DOTALL)
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]*)(?:#([^)\s]+))?\)")

EVERYTHING = (
    "method=mcp task=holdout",
    "method=mcp task=imitation character=biped",
    "method=mcp task=heading character=biped stage=transfer",
    "method=mcp task=carry character=biped stage=transfer",
    "method=mcp exploration=weights stage=transfer",
    "method=mcp preset=paper",
    "method=hierarchical task=heading character=biped stage=transfer",
    "method=option_critic task=imitation character=biped",
    "method=latent_space task=imitation character=biped",
    "method=finetune task=imitation character=biped",
)
"""Commands whose configurations hold every setting between them."""


def pages_with(pattern):
    pages = sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts)
    return [page for page in pages if pattern.search(page.read_text())]


def composed(arguments):
    """The configuration that a command would run, the first of several; Hydra refuses what does not exist."""
    line = arguments.replace("\\\n", " ")
    words = [word for word in shlex.split(line, comments=True) if not word.startswith("hydra")]
    overrides = [re.sub(r"(?<==)(?:choice\()?([\w.-]+),.*", r"\1", word) for word in words if "=" in word]
    if of_own_files(arguments):
        overrides.append(f"hydra.searchpath=[file://{Path('own').absolute()}]")
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        return compose("train", [*overrides, "run_dir=runs/never"], return_hydra_config=True)


def of_own_files(arguments):
    return "--config-dir own" in arguments or "hydra.searchpath" in arguments


def run(tutorial, namespace):
    """Execute all Python of a tutorial in one namespace; examples with a prompt must print what they show."""
    text = tutorial.read_text()
    for block in BLOCK.finditer(text):
        kind, code = block.groups()
        line = text.count("\n", 0, block.start()) + 1
        if kind == "python":
            exec(compile("\n" * line + code, str(tutorial), "exec"), namespace)
        else:
            example = doctest.DocTestParser().get_doctest(code, namespace, tutorial.name, str(tutorial), line)
            doctest.DebugRunner().run(example, clear_globs=False)
            namespace.update(example.globs)


@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_the_code_of_a_tutorial_runs_from_top_to_bottom_and_its_commands_find_it(tutorial, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(CHARACTERS, "bench", None)  # is taken out again afterwards
    module = ModuleType("bench")
    module.__file__ = str(tmp_path / "bench.py")
    monkeypatch.setitem(sys.modules, "bench", module)
    text = tutorial.read_text()
    for name, content in FILE.findall(text):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(content)
    for name in SHOWN.findall(text):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(tutorial.parent / name, name)

    run(tutorial, module.__dict__)

    for arguments in filter(of_own_files, COMMAND.findall(text)):
        cfg = composed(arguments)
        env = build.make_env(cfg, num_envs=2, seed=0)
        policy = build.make_agent(cfg, env).actor.policy
        with torch.autocast("cpu", torch.bfloat16), torch.no_grad():
            assert env.rollout(2, policy)["next", "reward"].isfinite().all()


@pytest.mark.parametrize("page", pages_with(COMMAND), ids=lambda path: path.stem)
def test_every_training_command_names_settings_that_exist(page):
    for arguments in COMMAND.findall(page.read_text()):
        if not of_own_files(arguments):
            assert composed(arguments).method.name


@pytest.fixture(scope="module")
def configurations():
    return [composed(choices) for choices in EVERYTHING]


def test_every_setting_that_a_table_names_is_in_the_configuration(configurations):
    text = (DOCS / "decisions.md").read_text()
    rows = [row.strip("|").split("|") for row in text.splitlines() if row.startswith("| ")]
    names = {name for row in rows for name in re.findall(r"`(\+?[\w.]+)`", row[-1])}
    assert len(names) > 50
    for name in names - set(configurations[0].hydra.runtime.choices):
        assert any(exists(cfg, name) for cfg in configurations) or of_the_paper_alone(configurations, name), name


def of_the_paper_alone(configurations, name):
    """Whether a setting needs its plus because only ``preset=paper`` has it."""
    having = [choices for choices, cfg in zip(EVERYTHING, configurations, strict=True) if exists(cfg, name[1:])]
    return name.startswith("+") and having == ["method=mcp preset=paper"]


def exists(cfg, name):
    """Whether a setting is in a configuration, be its value null; or, after a plus, an argument of what it makes."""
    *path, last = name.removeprefix("+").split(".")
    parent = OmegaConf.select(cfg, ".".join(path)) if path else cfg
    if not isinstance(parent, DictConfig):
        return False
    if not name.startswith("+"):
        return last in parent
    return last not in parent and "_target_" in parent and last in taken.arguments(parent._target_)


@pytest.mark.parametrize("page", pages_with(INCLUDE), ids=lambda path: path.stem)
def test_what_a_page_includes_of_another_is_there(page):
    for path, options in INCLUDE.findall(page.read_text()):
        lines = (page.parent / path).read_text().splitlines()
        for text in re.findall(r':(?:start-after|end-before): "(.*)"', options):
            assert text in lines, (path, text)


def headings(page):
    """Anchors of the headings of a page and its included pages, as GitHub and MyST form them."""
    text = INCLUDE.sub(lambda match: (page.parent / match[1]).read_text(), page.read_text())
    titles = re.findall(r"^#+ (.*)$", FENCE.sub("", text), re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "README.md", *pages_with(LINK)],
    ids=lambda path: f"{path.parent.name}/{path.stem}",
)
def test_every_link_leads_to_a_file_and_to_a_single_heading_of_it(page):
    for path, anchor in LINK.findall(FENCE.sub("", page.read_text())):
        target = page.parent / path if path else page
        assert target.exists(), path
        assert not anchor or headings(target).count(anchor) == 1, (path, anchor)


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_every_return_of_the_results_is_in_a_table_of_the_archives_or_in_the_paper(page):
    results = ROOT / "benchmarks" / "results"
    tables = "".join(table.read_text() for table in (results / "table2").glob("*.md"))
    tables += (results / "ablations" / "table.md").read_text()
    with (results / "ideal.csv").open(newline="") as file:
        known = {f"{float(row[name]):.3f}" for row in csv.DictReader(file) for name in ("standing", "ideal")}
    known |= set(re.findall(r"\b\d\.\d{3}\b", tables)) | {f"{reported.mean:.3f}" for reported in TABLE_2.values()}
    shown = set(re.findall(r"\b\d\.\d{3}\b", (ROOT / page).read_text()))
    assert len(shown) > 10
    assert shown <= known


def test_what_a_return_can_reach_is_what_was_measured():
    """The table of the results page has the rows of ``ideal.csv``."""
    with (ROOT / "benchmarks" / "results" / "ideal.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    page = (DOCS / "results.md").read_text()
    for task, setting, title in (
        ("heading", "-", "heading"),
        ("carry", "-", "carry"),
        ("dribble", "-", "dribble"),
        ("dribble", "success_reward=True", "dribble, reward 1 while successful"),
    ):
        (row,) = (row for row in rows if [row["task"], row["character"], row["changes"]] == [task, "biped", setting])
        assert f"| {title} | {float(row['standing']):.3f} | {float(row['ideal']):.3f} |" in page


def test_every_module_has_its_place_in_the_reference():
    pages = "".join(page.read_text() for page in (DOCS / "api").glob("*.md"))
    documented = set(re.findall(r"automodule:: (\S+)", pages))
    for name in modules():
        if name.startswith("torchrl_mcp.commands"):
            continue  # commands have a page of their own
        packages = [importlib.import_module(package) for package in accumulate(name.split(".")[:-1], "{}.{}".format)]
        exports = (getattr(package, export) for package in packages for export in getattr(package, "__all__", ()))
        exported = {getattr(export, "__module__", None) for export in exports}
        assert name in documented | exported, f"{name}: add it to a page of docs/api"


def modules():
    """Names of all modules that are not packages themselves."""
    for package, folder in PACKAGES.items():
        for path in sorted(folder.rglob("*.py")):
            if not path.name.startswith("_"):
                yield ".".join([package, *path.relative_to(folder).with_suffix("").parts])


def test_a_module_of_your_own_checks_nothing_when_it_is_imported():
    blocks = [code for kind, code in BLOCK.findall((DOCS / "tutorials" / "world.md").read_text()) if kind == "python"]
    for code in blocks:
        assert code.startswith("# check.py\n") == any(word in code for word in ("assert ", "env = ", "write_text(")), (
            code
        )


def test_the_page_of_commands_has_every_option_of_every_command(monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "_extensions")
    pytest.importorskip("sphinx", reason="sphinx is not installed: make docs installs it")
    page = importlib.import_module("commands").page()
    for name, module in (("export", "--onnx FILE"), ("motions import", "--mirror"), ("play", "--viewer {web,window}")):
        _, _, section = page.partition(f"torchrl-mcp-{name}\n")
        assert f"`{module}`" in section.partition("\n## ")[0]
    for module in sorted((PACKAGES["torchrl_mcp"] / "commands").glob("*.py")):
        for option in re.findall(r'add_argument\(\s*"(?:-\w+", ")?(--[\w-]+)"', module.read_text()):
            assert option == "--version" or option in page, option

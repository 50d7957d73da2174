import csv
import json
from functools import cache, partial
from html.parser import HTMLParser
from pathlib import Path

import pytest
from archives import unpack
from omegaconf import OmegaConf

from torchrl_mcp.report.results import find_runs
from torchrl_mcp.runs.configuration import compose_run

CONF = Path(__file__).parents[2] / "conf"
TABLE_2 = Path(__file__).parents[2] / "benchmarks/results/table2"
MACHINE = {"processor": "Abacus", "cores": 2, "device": "cpu", "python": "3.11", "torch": "2.13", "mujoco": "3.17"}


def numbers(value, diagnostics):
    """What an evaluation says of one mode."""
    interval = [value - 0.02, value + 0.02]
    episodes = {"return": 600 * value, "length": 450.0, "terminated": 0.25, "episodes": 128}
    return {"normalised_return": value, "interval": interval, "metrics": {}, "diagnostics": diagnostics} | episodes


VOID = {"meta", "br", "link", "img", "hr", "input"}
GATES = {"gates/effective_primitives": 2.5, "gates/sum": 1.5, "gates/usage_0": 0.9, "gates/usage_1": 0.6}
PAPERS_MCP = {
    "num_primitives": 8,
    "mixer__name": "multiplicative",
    "exploration__name": "action",
    "transfer__keep": ["primitives", "observation_normaliser"],
    "transfer__freeze": ["primitives", "observation_normaliser"],
}


@cache
def declared(method):
    """Title and own settings of a method, nothing of a method that the library lacks."""
    if not (CONF / "method" / f"{method}.yaml").exists():
        return {}
    content = OmegaConf.to_container(compose_run(f"method={method}").method, resolve=True)
    return {name: content[name] for name in ("title", "standard")}


def write(
    root,
    name,
    *,
    method="scratch",
    task="heading",
    character="biped",
    stage="transfer",
    seed=0,
    score=None,
    progress=1.0,
    total_frames=1000,
    commit="abc1234",
    preset="fast",
    symmetry="none",
    diagnostics=(),
    episodes=128,
    environment=None,
    **settings,
):
    folder = root / name
    folder.mkdir(parents=True)
    cfg = OmegaConf.create({"seed": seed, "run_dir": str(folder), "training": {"total_frames": total_frames}})
    for group, choice in {"task": task, "character": character, "stage": stage, "method": method}.items():
        cfg[group] = {"name": choice}
    cfg.method = {**cfg.method, **declared(method)}
    for key, value in settings.items():
        OmegaConf.update(cfg, key.replace("__", "."), value)
    OmegaConf.save(cfg, folder / "config.yaml")
    frames = [round(total_frames * progress * step / 10) for step in range(1, 11)] if progress else []
    rows = [(i, x, x / 100, 1, 0.5) for i, x in enumerate(frames, start=1)]
    with (folder / "metrics.csv").open("w", newline="") as file:
        columns = ["iteration", "frames", "seconds", "episode/count", "episode/normalised_return"]
        csv.writer(file).writerows([columns, *rows] if rows else [])
    if preset:
        choices = {"preset": preset, "symmetry": symmetry}
        origin = {"command": ["torchrl-mcp-train"], "commit": commit, "choices": choices, "machine": MACHINE}
        (folder / "origin.json").write_text(json.dumps(origin))
    if score is not None:
        modes = {"deterministic": score, "stochastic": score - 0.1}
        found = {mode: numbers(value, dict(diagnostics)) for mode, value in modes.items()}
        protocol = {"episodes": episodes, "seed": 12345, "environment": environment or {}}
        (folder / "evaluation.json").write_text(json.dumps(protocol | found))
    return folder


@pytest.fixture(scope="session")
def run_writers():
    """Of a folder, what writes runs into it: of any method, and of MCP with the paper's settings by default.

    Of scores, the deterministic is given and the stochastic 0.1 lower.
    """

    def write_mcp(root, name, **settings):
        return write(root, name, **{"method": "mcp"} | PAPERS_MCP | settings)

    return lambda root: (partial(write, root), partial(write_mcp, root))


@pytest.fixture
def write_run(run_writers, tmp_path):
    return run_writers(tmp_path / "runs")[0]


@pytest.fixture
def write_mcp(run_writers, tmp_path):
    return run_writers(tmp_path / "runs")[1]


@pytest.fixture(scope="session")
def published(tmp_path_factory):
    """The published runs of Table 2: their folder, and what is read from it."""
    folder = unpack(TABLE_2 / "runs.tar.xz", tmp_path_factory.mktemp("published"))
    runs, damaged = find_runs([folder])
    assert not damaged
    return folder, runs


@pytest.fixture(scope="session")
def varied_runs(run_writers, tmp_path_factory):
    """A folder of runs in all states, of several tasks, with an ablation."""
    folder = tmp_path_factory.mktemp("runs")
    write_run, write_mcp = run_writers(folder)
    for seed, score in enumerate([0.4, 0.5, 0.9]):
        write_run(f"scratch-{seed}", seed=seed, score=score)
        write_mcp(f"mcp-{seed}", seed=seed, score=score / 2, diagnostics=GATES)
        write_mcp(f"four-{seed}", seed=seed, score=0.3, num_primitives=4, diagnostics=GATES)
    write_run("carry", task="carry", score=0.25, commit="fff0000")
    write_mcp("carried", task="carry", score=0.125)
    write_run("unfinished", task="carry", seed=1, progress=0.25)
    write_mcp("waiting", method="moe", task="dribble", character="trex", mixer__name="additive")
    write_mcp("pretraining", stage="pretrain", task="imitation", score=0.6)
    (write_run("damaged|<b>", score=0.5) / "evaluation.json").write_text("{")
    (write_run("lost", score=0.5) / "config.yaml").write_text("[")
    return folder


class Element:
    def __init__(self, tag, attributes, parent):
        self.tag, self.attributes, self.parent, self.children = tag, attributes, parent, []

    @property
    def text(self):
        return " ".join("".join(c if isinstance(c, str) else f" {c.text} " for c in self.children).split())

    def all(self, *tags):
        for child in self.children:
            if isinstance(child, Element):
                if child.tag in tags or not tags:
                    yield child
                yield from child.all(*tags)


class Tree(HTMLParser):
    """The elements of a page; a tag that is closed out of turn is an error."""

    def __init__(self, text):
        super().__init__()
        self.root = self.open = Element("root", {}, None)
        self.feed(text)
        self.close()
        assert self.open is self.root

    def handle_starttag(self, tag, attrs):
        assert len(dict(attrs)) == len(attrs)
        element = Element(tag, dict(attrs), self.open)
        self.open.children.append(element)
        if tag not in VOID:
            self.open = element

    def handle_startendtag(self, tag, attrs):
        self.open.children.append(Element(tag, dict(attrs), self.open))

    def handle_endtag(self, tag):
        assert tag == self.open.tag
        self.open = self.open.parent

    def handle_data(self, data):
        self.open.children.append(data)


@pytest.fixture(scope="session")
def parse_page():
    """A function from the text of a page to its root element."""
    return lambda text: Tree(text).root

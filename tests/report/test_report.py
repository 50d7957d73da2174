import json
import math
import random
import re
import sys
from datetime import UTC, datetime
from html.parser import HTMLParser
from itertools import pairwise

import pytest

from torchrl_mcp.cli.report import main
from torchrl_mcp.report.page import report
from torchrl_mcp.report.results import find_runs

MOMENT = datetime(2026, 1, 2, 3, 4, tzinfo=UTC)
VOID = {"meta", "br", "link", "img", "hr", "input"}
GATES = {"gates/effective_primitives": 2.5, "gates/sum": 1.5, "gates/usage_0": 0.9, "gates/usage_1": 0.6}


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


@pytest.fixture(scope="module")
def runs(run_writers, tmp_path_factory):
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


@pytest.fixture(scope="module")
def pages(runs):
    return report(*find_runs([runs]), moment=MOMENT)


@pytest.fixture(scope="module")
def page(pages):
    return Tree(pages["report.html"]).root


def section(page, name):
    (found,) = (element for element in page.all("section") if element.attributes["id"] == name)
    return found


def rows(table):
    """Texts of the cells of each row."""
    return [[cell.text for cell in row.all("th", "td")] for row in table.all("tr")]


def test_a_row_has_our_figures_beside_the_papers(page):
    table = next(section(page, "transfer").all("table"))
    scratch = next(row for row in rows(table) if row[0] == "Scratch")
    assert scratch == [
        *("Scratch", "0.600 ± 0.265 range 0.400 to 0.900", "0.500 ± 0.265 range 0.300 to 0.800"),
        *("0.927 ± 0.032", "−0.327"),
        *("3 of 4", "1,000", "10 s", "100", "fast", "abc1234"),
    ]


def test_the_overview_has_a_row_per_task_and_a_column_per_method(page):
    header, heading, carry, dribble = rows(next(section(page, "overview").all("table")))
    assert header == ["Task", "Scratch", "MOE", "MCP"]
    assert heading == [
        "Heading: Biped",
        "0.600 ± 0.265 0.927 ± 0.032",
        "– 0.918 ± 0.002",
        "0.300 ± 0.132 0.976 ± 0.002",
    ]
    assert carry == ["Carry: Biped", "0.250 ± 0.000 0.027 ± 0.035", "– 0.013 ± 0.013", "0.125 ± 0.000 0.575 ± 0.032"]
    assert dribble == ["Dribble: T-Rex", "– 0.065 ± 0.032", "not evaluated 0.070 ± 0.017", "– 0.781 ± 0.021"]


def test_the_deviation_of_a_single_seed_is_only_room_left_blank(page):
    blanks = [e for e in page.all("span") if e.attributes.get("class") == "blank"]
    assert blanks
    assert all(blank.attributes["aria-hidden"] == "true" for blank in blanks)


def test_the_best_of_each_column_is_bold(page):
    table = next(section(page, "transfer").all("table"))
    assert [element.text for element in table.all("strong")] == ["0.600", "0.500"]


def test_methods_are_compared_over_all_tasks(page):
    _, table = section(page, "overview").all("table")
    # Of 0.4, 0.5, 0.9 and 0.25 the middle two; of half of each, half.
    assert [row[:2] for row in rows(table)[1:]] == [["Scratch", "0.450"], ["MCP", "0.225"]]


def test_an_ablation_compares_its_settings(page):
    (table,) = section(page, "ablations").all("table")
    assert [row[:2] for row in rows(table)] == [
        ["Setting", "Deterministic"],
        ["4 primitives", "0.300 ± 0.000 range 0.300 to 0.300"],
        ["8 primitives", "0.300 ± 0.132 range 0.200 to 0.450"],
    ]


def test_every_task_has_learning_curves_of_its_methods(page):
    figures = list(section(page, "transfer").all("figure"))
    legends = [[item.text for item in figure.all("li")] for figure in figures]
    assert legends == [["Scratch", "MCP"], ["Scratch", "MCP"], ["MOE"]]
    descriptions = [
        svg.attributes["aria-label"] for figure in figures for svg in figure.all("svg") if "role" in svg.attributes
    ]
    assert [text.partition(":")[0] for text in descriptions] == ["Heading", "Carry", "Dribble"]
    assert "environment steps" in figures[0].text


def test_what_is_not_complete_is_told(page):
    notes = [item.text for item in section(page, "transfer").all("li")]
    assert "note seed 1 unfinished, 25% of the steps (Scratch)" in notes
    assert "note seed 0 not evaluated (MOE)" in notes
    assert "note seed 0 damaged (Scratch)" in notes
    assert "mixed commits: abc1234, fff0000" in notes
    states = {row[-1].rpartition("/")[2]: row[3:6] for row in rows(next(section(page, "runs").all("table")))}
    assert states["unfinished"] == ["1", "unfinished", "250 of 1,000"]


def test_damaged_folders_are_listed_with_the_reason(page):
    listed = rows(next(section(page, "damaged").all("table")))[1:]
    assert sorted((folder.rpartition("/")[2], reason.partition(":")[0]) for folder, reason in listed) == [
        ("damaged|<b>", "evaluation.json cannot be read"),
        ("lost", "config.yaml cannot be read"),
    ]


def test_diagnostics_of_gates_are_shown_with_a_group_of_bars_per_seed(page):
    table = next(section(page, "diagnostics").all("table"))
    row = next(row for row in table.all("tr") if "MCP" in row.text)
    assert [cell.text for cell in row.all("td")][:3] == ["MCP", "2.500", "1.500"]
    bars = list(row.all("svg"))
    assert [bar.attributes["aria-label"] for bar in bars] == [f"Usage, seed {seed}: 0.900 0.600" for seed in range(3)]
    assert [float(rect.attributes["height"]) for rect in bars[0].all("rect")] == pytest.approx([20, 20 * 0.6 / 0.9])


def test_the_page_loads_nothing(pages):
    html = pages["report.html"]
    for element in Tree(html).root.all():
        assert element.tag not in {"script", "link", "img", "iframe", "object", "embed", "image", "base"}
        for name, value in element.attributes.items():
            if name in {"href", "xlink:href", "src", "srcset", "data", "action"}:
                assert value.startswith("#")
    assert not re.search(r"@import|url\((?!#)", html)


def test_every_reference_inside_the_page_has_one_target(page):
    identifiers = [element.attributes["id"] for element in page.all() if "id" in element.attributes]
    assert len(set(identifiers)) == len(identifiers)
    for element in page.all():
        for target in re.findall(
            r"#([\w.-]+)", element.attributes.get("href", element.attributes.get("xlink:href", ""))
        ):
            assert target in identifiers
        for target in re.findall(r"url\(#([\w.-]+)\)", " ".join(filter(None, element.attributes.values()))):
            assert target in identifiers


def test_html5_parsers_find_no_error(pages):
    html5lib = pytest.importorskip("html5lib")
    html5lib.HTMLParser(strict=True).parse(pages["report.html"])


def test_those_who_do_not_see_find_their_way(page):
    assert next(page.all("html")).attributes["lang"] == "en"
    assert next(page.all("title")).text
    levels = [int(element.tag[1]) for element in page.all("h1", "h2", "h3", "h4")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    for table in page.all("table"):
        assert next(table.all("caption")).text
        assert all(th.attributes["scope"] in {"row", "col"} for th in table.all("th"))
        assert table.parent.attributes["class"] == "scroll"
        assert table.parent.attributes["tabindex"] == "0"
        assert table.parent.attributes["aria-label"]
    for svg in page.all("svg"):
        assert svg.attributes.get("aria-hidden") == "true" or svg.attributes["aria-label"].strip()


def test_every_row_of_a_table_has_as_many_cells_as_its_header(page):
    for table in page.all("table"):
        assert len({len(row) for row in rows(table)}) == 1


def test_markdown_has_the_same_figures_in_whole_tables(pages):
    markdown = pages["report.md"]
    blocks = re.findall(r"(?:^\|.*\n)+", markdown, flags=re.MULTILINE)
    assert len(blocks) >= 6
    for block in blocks:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1
    line = next(line for line in markdown.splitlines() if line.startswith("| Scratch |"))
    assert line.startswith(
        "| Scratch | **0.600** ± 0.265 (range 0.400 to 0.900) | **0.500** ± 0.265 (range 0.300 to 0.800) | "
        "0.927 ± 0.032 | −0.327 |"
    )
    assert r"damaged\|<b>" in markdown
    assert "- Seed 1 unfinished, 25% of the steps (Scratch)." in markdown


def test_a_report_is_the_same_bytes_again(runs, pages):
    assert report(*find_runs([runs]), moment=MOMENT) == pages


@pytest.mark.parametrize("progress", [0.0, 0.5])
def test_a_run_that_has_just_begun_makes_a_report(write_run, progress):
    folder = write_run("run", progress=progress, preset=None)
    html = report(*find_runs([folder]), moment=MOMENT)["report.html"]
    assert f"{progress:.0%} trained" in Tree(html).root.text


def test_damaged_folders_alone_make_a_report(write_run):
    folder = write_run("run")
    (folder / "config.yaml").write_text("[")
    assert "1 damaged" in Tree(report(*find_runs([folder]), moment=MOMENT)["report.html"]).root.text


def test_the_range_of_two_seeds_is_called_so_and_the_mixers_equations_are_the_papers(write_mcp):
    folders = [
        write_mcp(f"{mixer}{seed}", mixer__name=mixer, seed=seed, score=0.5 + seed / 10)
        for mixer in ("multiplicative", "additive")
        for seed in range(2)
    ]
    for page in report(*find_runs(folders), moment=MOMENT).values():
        assert "range 0.500 to 0.600" in page
        assert "composed by Eq. 3, multiplicative, or by Eq. 1, additive" in page


def test_the_command_writes_both_files(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-report", str(runs), "--output", str(tmp_path / "a" / "b")])
    main()
    assert capsys.readouterr().out.startswith("16 runs, 12 complete, 1 not evaluated, 1 unfinished, 2 damaged: ")
    assert sorted(path.name for path in (tmp_path / "a" / "b").iterdir()) == ["report.html", "report.md"]


def test_the_command_tells_what_is_wrong_with_its_arguments(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-report", str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit, match=r"torchrl-mcp-report: there is no folder .*nowhere"):
        main()


def test_the_command_tells_that_a_folder_holds_no_run(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["torchrl-mcp-report", str(tmp_path)])
    with pytest.raises(SystemExit, match="holds no run: give folders"):
        main()


JUNK = [None, True, -1, 1e400, math.nan, "", "many", "<b>", [], [[]], {}, {"a": {}}, "9" * 400]


def spoil(content, generator):
    """Replace, remove or add a value somewhere in a tree of objects."""
    inside = [content] + [value for value in content.values() if isinstance(value, dict)]
    target = generator.choice(inside)
    key = generator.choice([*target, "surprise"]) if target else "surprise"
    if generator.random() < 0.2:
        target.pop(key, None)
    else:
        target[key] = generator.choice(JUNK)


def test_however_the_files_of_runs_are_damaged_the_others_are_reported(write_run, tmp_path):
    generator = random.Random(0)
    write_run("whole", score=0.625, method="scratch")
    for number in range(150):
        folder = write_run(f"damaged{number}", score=0.5, seed=number + 1)
        file = folder / ("evaluation.json", "origin.json")[number % 2]
        content = json.loads(file.read_text())
        for _ in range(1 + number % 3):
            spoil(content, generator)
        file.write_text(json.dumps(content))
    runs, damaged = find_runs([tmp_path])
    assert len(runs) + len(damaged) == 151
    pages = report(runs, damaged, moment=datetime.now(UTC))
    faulty = [run for run in runs if run.state == "damaged"]
    assert 30 < len(faulty) < 150
    assert all(str(run.path) in pages["report.md"] for run in faulty)
    assert [run.state for run in runs if run.path.name == "whole"] == ["complete"]


def test_what_the_environment_holds_does_not_get_into_a_report(write_run, tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "swordfish")
    write_run("received", score=0.5, method__title="${oc.env:SECRET}")
    pages = report(*find_runs([tmp_path]), moment=datetime.now(UTC))
    assert "swordfish" not in "".join(pages.values())

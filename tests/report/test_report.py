import re
from datetime import UTC, datetime
from itertools import pairwise

import pytest

from torchrl_mcp.report.page import report
from torchrl_mcp.report.results import find_runs

MOMENT = datetime(2026, 1, 2, 3, 4, tzinfo=UTC)


@pytest.fixture(scope="module")
def pages(varied_runs):
    return report(*find_runs([varied_runs]), moment=MOMENT)


@pytest.fixture(scope="module")
def page(pages, parse_page):
    return parse_page(pages["report.html"])


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
        *("3", "1,000", "10 s", "100", "fast", "abc1234"),
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
    # Tasks weigh the same: of 0.4, 0.5, 0.9 and three times 0.25 the middle four; of half of each, half.
    assert [row[:2] for row in rows(table)[1:]] == [["Scratch", "0.350"], ["MCP", "0.175"]]


def test_a_single_method_or_task_is_no_comparison(write_run, write_mcp):
    alone = [write_run(task, task=task, score=0.5) for task in ("heading", "carry")]
    for folders in (alone, [alone[0], write_mcp("mcp", score=0.5)]):
        assert not any("Over all tasks" in page for page in report(*find_runs(folders), moment=MOMENT).values())


def test_diagnostics_tell_the_stages_of_a_task_apart(write_mcp, parse_page):
    gates = {"gates/effective_primitives": 2.0, "gates/usage_0": 1.0}
    for stage in ("pretrain", "transfer"):
        folder = write_mcp(stage, stage=stage, task="holdout", character="ant", score=0.5, diagnostics=gates)
    pages = report(*find_runs([folder.parent]), moment=MOMENT)
    _, *found = rows(next(section(parse_page(pages["report.html"]), "diagnostics").all("table")))
    assert sorted(row[1] for row in found) == ["pretrain", "transfer"]
    _, table = pages["report.md"].split("## Gates", 1)
    assert [line.split(" | ")[1] for line in table.splitlines() if "Holdout" in line] == [row[1] for row in found]


def test_where_the_paper_has_no_number_nothing_is_compared_with_it(write_mcp, write_run, page, pages, parse_page):
    for write, name in ((write_mcp, "mcp"), (write_run, "scratch")):
        folder = write(name, task="juggle", score=0.5)
    alone = report(*find_runs([folder.parent]), moment=MOMENT)
    assert "paper" not in alone["report.md"]
    own = parse_page(alone["report.html"])
    assert not [name for name in ("overview", "transfer", "reading") if "paper" in section(own, name).text]
    assert "paper" in pages["report.md"]
    assert all("paper" in section(page, name).text for name in ("overview", "transfer", "reading"))


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


def test_methods_whose_seeds_have_no_steps_in_common_are_listed_beside_the_plot(write_run, write_mcp, parse_page):
    write_mcp("whole", score=0.5)
    early, late = (write_run(name, seed=seed, progress=0.1) for seed, name in enumerate(["early", "late"]))
    lines = (late / "metrics.csv").read_text().split()
    (late / "metrics.csv").write_text(f"{lines[0]}\n9,1000,10,1,0.5\n")  # the rows before are lost
    pages = report(*find_runs([early.parent]), moment=MOMENT)
    (figure,) = section(parse_page(pages["report.html"]), "transfer").all("figure")
    assert [item.text for item in figure.all("li")] == ["Scratch", "MCP"]
    assert "too few episodes have ended: Scratch" in figure.text


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
    assert [cell.text for cell in row.all("td")][:4] == ["transfer", "MCP", "2.500", "1.500"]
    bars = list(row.all("svg"))
    assert [bar.attributes["aria-label"] for bar in bars] == [f"Usage, seed {seed}: 0.900 0.600" for seed in range(3)]
    assert [float(rect.attributes["height"]) for rect in bars[0].all("rect")] == pytest.approx([20, 20 * 0.6 / 0.9])


def test_the_page_loads_nothing(pages, parse_page):
    html = pages["report.html"]
    for element in parse_page(html).all():
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


def test_a_report_is_the_same_bytes_again(varied_runs, pages):
    assert report(*find_runs([varied_runs]), moment=MOMENT) == pages


def test_the_range_of_two_seeds_is_called_so_and_the_mixers_equations_are_the_papers(write_mcp):
    folders = [
        write_mcp(f"{mixer}{seed}", mixer__name=mixer, seed=seed, score=0.5 + seed / 10)
        for mixer in ("multiplicative", "additive")
        for seed in range(2)
    ]
    for page in report(*find_runs(folders), moment=MOMENT).values():
        assert "range 0.500 to 0.600" in page
        assert "Multiplicative composition of primitives (Eq. 3), or additive (Eq. 1)" in page


def test_networks_of_which_a_third_of_a_layer_is_dead_after_training_are_named(write_run, parse_page):
    for name, progress, shares in (("dying", 1.0, (0.4, 0.2)), ("young", 0.5, (0.4, 0.4)), ("alive", 1.0, (0.1, 0.1))):
        folder = write_run(name, seed=len(name), progress=progress, score=0.5)
        header, *lines = (folder / "metrics.csv").read_text().split()
        lines = [f"{line},0.9,0.9" for line in lines[:-1]] + ["{},{},{}".format(lines[-1], *shares)]
        metrics = [f"{header},dead_units/critic,dead_units/gating", *lines]
        (folder / "metrics.csv").write_text("\n".join(metrics) + "\n")
    pages = report(*find_runs([folder.parent]), moment=MOMENT)
    remarks = [
        text for row in rows(next(section(parse_page(pages["report.html"]), "runs").all("table"))) for text in row
    ]
    assert [text for text in remarks if "dead" in text] == ["complete critic: 40% dead"]
    assert [line for line in pages["report.md"].splitlines() if "critic 40%" in line] == [
        f"- {folder.parent}/dying: critic 40%"
    ]

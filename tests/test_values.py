"""Types with rules: what a rule allows, where a rule is found, and which functions check their arguments."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from omegaconf import OmegaConf
from refusals import refused

from torchrl_mcp.values import (
    Count,
    Discount,
    Names,
    NotNegative,
    Positive,
    PositiveOrInfinite,
    Probability,
    Range,
    Share,
    Speed,
    Text,
    Weights,
    Whole,
    Widths,
    checked,
    rule_of,
    type_of_entry,
)

ALLOWED = [
    (Count, [1, 7, np.int64(3)], [0, -1, 1.0, True, "1", None, math.nan]),
    (Whole, [0, 1], [-1, 0.5, False]),
    (Positive, [1, 0.5, np.float32(2)], [0, -1.0, math.inf, math.nan, True, "1"]),
    (NotNegative, [0, 0.0, 3], [-0.1, math.inf]),
    (Share, [0, 1, 0.5], [-0.1, 1.1, math.nan]),
    (Discount, [0, 0.99], [1, -0.1]),
    (Probability, [0.5], [0, 1]),
    (PositiveOrInfinite, [1, math.inf], [0, -1, math.nan, True]),
    (Range, [[0, 0], (0.0, 1.0), OmegaConf.create([-1, 1])], [[1, 0], [1], [0, 1, 2], [0, math.inf], 1.0, "ab"]),
    (Speed, [1.0, [0, 1]], [0, [0, 0], [-1, 1], [1, 0]]),
    (Widths, [[1], (512, 256)], [[], [0], [1.5], 5]),
    (Weights, [[], [0, 1.5]], [[-1], 1]),
    (Names, [[], ["gate"]], ["gate", [1], [""]]),
    (Text, ["a"], ["", 1, None]),
    (bool, [True, False], [0, 1, "true", None]),
    (Count | None, [1, None], [0]),
    (Literal[1, 2], [1, 2, 1.0], [True, 3]),
    (bool | Literal["auto"], [True, "auto"], ["car", 2]),
    (Literal["rest"] | Mapping[str, Share], ["rest", {"rest": 5}], ["run", 1]),
]


@pytest.mark.parametrize(("annotation", "allowed", "wrong"), ALLOWED, ids=str)
def test_a_rule_allows_the_values_that_its_words_describe(annotation, allowed, wrong):
    rule = rule_of(annotation)
    assert all(rule.allows(value) for value in allowed)
    assert not any(rule.allows(value) for value in wrong)


@pytest.mark.parametrize("annotation", [int, float, str, Any, None, Count | str, Sequence[int]], ids=str)
def test_types_that_leave_values_open_have_no_rule(annotation):
    assert rule_of(annotation) is None


@dataclass
class Term:
    """A group of settings."""

    weight: Positive
    children: "Sequence[Term]"


@pytest.mark.parametrize(
    "annotation",
    [Term, Term | None, Annotated[Mapping[str, float], Term], {"weight": Positive}, Mapping[str, Positive]],
    ids=str,
)
def test_the_entries_of_a_group_have_the_types_of_its_fields(annotation):
    assert type_of_entry(annotation, "weight") is Positive
    assert rule_of(annotation).allows({"weight": 1})
    assert not rule_of(annotation).allows(1)


def test_groups_contain_groups_and_lists_of_groups():
    assert type_of_entry(type_of_entry(Term, "children"), 3) is Term
    assert type_of_entry(Term, "colour") is None


@checked
def play(times: Count, *rest: int, speed: Positive = 1.0, **others: bool) -> tuple[Any, ...]:
    """A function that checks its arguments."""
    return times, rest, speed, others


def test_a_checked_function_takes_its_arguments_as_before():
    assert play(2, 0, speed=3, loud=1) == (2, (0,), 3, {"loud": 1})
    assert play(1) == (1, (), 1.0, {})
    assert play.__doc__ == "A function that checks its arguments."


@pytest.mark.parametrize(("arguments", "name"), [({"times": 0}, "times=0"), ({"times": 1, "speed": -1}, "speed=-1")])
def test_a_checked_function_names_a_wrong_argument_with_its_value(arguments, name):
    refused(lambda: play(**arguments), name)

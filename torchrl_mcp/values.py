"""Types of settings with rules for their values, such as :data:`Count`, a whole number of at least 1.

A parameter states its rule in its annotation. The annotation is the only place of the rule:

- :mod:`torchrl_mcp.runs.validation` checks the settings of a run by the types of the parameters that they are given to.
- :func:`checked` lets a function check its arguments, for callers that pass them in Python.

Type checkers see the plain types, such as ``int``.

>>> @checked
... def repeat(word: str, times: Count) -> str:
...     return word * times
>>> repeat("la", times=0)
Traceback (most recent call last):
ValueError: times=0 must be a whole number, at least 1
"""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache, wraps
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

P = ParamSpec("P")
T = TypeVar("T")


class Rule:
    """A rule for values, in ``Annotated[type, Rule(...)]``.

    Args:
        words: Description for error messages, which follows "must be".
        allows: Function that returns whether a value is valid.
    """

    def __init__(self, words: str, allows: Callable[[Any], bool]) -> None:
        self.words = words
        self.allows = allows

    def __repr__(self) -> str:
        """Return the words, which the documentation shows in the types of parameters."""
        return repr(self.words)


def is_whole(value: Any) -> bool:
    """Return whether a value is a whole number."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def is_list(value: Any, allows: Callable[[Any], bool]) -> bool:
    """Return whether a value is a sequence of allowed values."""
    return isinstance(value, Sequence) and not isinstance(value, str) and all(allows(item) for item in value)


def _is_range(value: Any) -> bool:
    return is_list(value, is_number) and len(value) == 2 and value[0] <= value[1]


SEEDS = 2**32
"""Number of seeds that all random generators accept."""

Count = Annotated[int, Rule("a whole number, at least 1", lambda value: is_whole(value) and value >= 1)]
Whole = Annotated[int, Rule("a whole number, at least 0", lambda value: is_whole(value) and value >= 0)]
Seed = Annotated[int, Rule(f"a whole number from 0 to {SEEDS - 1}", lambda n: is_whole(n) and 0 <= n < SEEDS)]
Finite = Annotated[float, Rule("a finite number", is_number)]
Positive = Annotated[float, Rule("a finite number above 0", lambda value: is_number(value) and value > 0)]
NotNegative = Annotated[float, Rule("a finite number, at least 0", lambda value: is_number(value) and value >= 0)]
Share = Annotated[float, Rule("a number from 0 to 1", lambda value: is_number(value) and 0 <= value <= 1)]
Discount = Annotated[float, Rule("a number from 0 to 1, below 1", lambda value: is_number(value) and 0 <= value < 1)]
Probability = Annotated[float, Rule("a number between 0 and 1", lambda value: is_number(value) and 0 < value < 1)]
# A time between events, a number of inputs or a bound; infinite for none
PositiveOrInfinite = Annotated[
    float,
    Rule(
        "a number above 0, or infinity (inf; in files and --task .inf)",
        lambda value: isinstance(value, Real) and not isinstance(value, bool) and value > 0,
    ),
]
Text = Annotated[str, Rule("a text", lambda value: isinstance(value, str) and bool(value))]
# Units of hidden layers
Widths = Annotated[
    Sequence[int],
    Rule(
        "a list of one or more whole numbers, each at least 1",
        lambda value: is_list(value, lambda item: is_whole(item) and item >= 1) and len(value) > 0,
    ),
]
Weights = Annotated[
    Sequence[float],
    Rule(
        "a list of finite numbers, each at least 0",
        lambda value: is_list(value, lambda item: is_number(item) and item >= 0),
    ),
]
Positives = Annotated[
    Sequence[float],
    Rule(
        "a list of finite numbers, each above 0",
        lambda value: is_list(value, lambda item: is_number(item) and item > 0) and len(value) > 0,
    ),
]
Names = Annotated[
    Sequence[str],
    Rule("a list of names", lambda value: is_list(value, lambda item: isinstance(item, str) and bool(item))),
]
Range = Annotated[Sequence[float], Rule("two finite numbers in order, [low, high]", _is_range)]
Speed = Annotated[
    float | Sequence[float],
    Rule(
        "a finite number above 0, or a range [low, high] from at least 0 to a number above 0",
        lambda value: (is_number(value) and value > 0) or (_is_range(value) and value[0] >= 0 and value[1] > 0),
    ),
]

GROUP = "a group of settings"
"""Description of groups of settings for error messages."""

FLAG = Rule("true or false", lambda value: isinstance(value, bool))
NULL = Rule("null", lambda value: value is None)


def rule_of(annotation: Any) -> Rule | None:
    """Return the rule of a type, or None if values of the type are not checked.

    The types with rules are ``Annotated[..., Rule(...)]``, ``Literal``, ``bool``, ``None``, groups of settings, which
    are ``Mapping`` and the classes of :func:`type_of_entry`, and unions of these types.
    """
    origin = get_origin(annotation)
    if origin is Annotated:
        rules = [part for part in annotation.__metadata__ if isinstance(part, Rule)]
        return rules[0] if rules else rule_of(get_args(annotation)[0])
    if origin is Literal:
        return _among(get_args(annotation))
    if origin in (Union, UnionType):
        return _any_of([rule_of(member) for member in get_args(annotation)])
    if annotation is bool:
        return FLAG
    if annotation is NoneType:
        return NULL
    if is_group_type(annotation):
        return _group(annotation)
    return None


def type_of_entry(annotation: Any, name: Any) -> Any:
    """Return the type of an entry in a group of settings, or None if its values are not checked.

    Args:
        annotation: Type of the group: ``Mapping``, ``Sequence``, ``TypedDict``, dataclass or ``NamedTuple``, a union of
            these types, ``Annotated`` with such a type as its metadata, or a mapping of types by the names of entries.
        name: Name of the entry, or its index in a sequence.
    """
    if isinstance(annotation, Mapping):
        return annotation.get(name)
    origin = get_origin(annotation)
    if origin in (Union, UnionType, Annotated):
        members = [*getattr(annotation, "__metadata__", ()), *get_args(annotation)]
        types = [type_of_entry(member, name) for member in members]
        return next((found for found in types if found is not None), None)
    if isinstance(origin, type) and issubclass(origin, Mapping | Sequence):
        return get_args(annotation)[-1]
    return types_of(annotation).get(name) if is_group_type(annotation) else None


def is_group_type(annotation: Any) -> bool:
    """Return whether a type is a group of settings, and not a union of a group and other types."""
    kind = get_origin(annotation) or annotation
    if not isinstance(kind, type):
        return isinstance(kind, Mapping)
    return issubclass(kind, Mapping) or is_dataclass(kind) or is_typeddict(kind) or hasattr(kind, "_fields")


def has_rules(annotation: Any) -> bool:
    """Return whether a type, or a type of its entries, has a rule."""
    return rule_of(annotation) is not None or any(map(has_rules, get_args(annotation)))


@cache
def types_of(function: Any) -> dict[str, Any]:
    """Return the types of the parameters of a function, or of the fields of a class, by name.

    The dictionary is empty if a type of another library exists for type checkers only.
    """
    try:
        types = get_type_hints(function, include_extras=True)
    except (NameError, TypeError, AttributeError):
        return {}
    types.pop("return", None)
    return types


def checked(function: Callable[P, T]) -> Callable[P, T]:
    """Let a function check its arguments by the rules of their types; decorate constructors with it.

    The function raises a ``ValueError`` that names the first wrong argument, its value and the rule.
    """
    signature = inspect.signature(function)
    parameters = signature.parameters

    @wraps(function)
    def check(*args: P.args, **kwargs: P.kwargs) -> T:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if parameters[name].kind is not inspect.Parameter.VAR_KEYWORD:
                require(name, value, types_of(function).get(name))
        return function(*args, **kwargs)

    return check


def require(name: str, value: Any, annotation: Any) -> None:
    """Check a value by the rule of its type, if the type has one.

    Raises:
        ValueError: If the value is wrong, with its name.
    """
    rule = rule_of(annotation)
    if rule and not rule.allows(value):
        raise ValueError(f"{name}={value!r} must be {rule.words}")


def shown(value: Any) -> str:
    """Return a value as configurations write it."""
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _group(annotation: Any) -> Rule:
    is_class = isinstance(annotation, type) and not is_typeddict(annotation)
    types = (Mapping, annotation) if is_class else (Mapping,)
    return Rule(GROUP, lambda value: isinstance(value, types))


def _among(choices: tuple[Any, ...]) -> Rule:
    words = [shown(choice) for choice in choices]
    listed = " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
    return Rule(listed, lambda value: any(value == choice and _same_kind(value, choice) for choice in choices))


def _same_kind(value: Any, choice: Any) -> bool:
    return isinstance(value, bool) == isinstance(choice, bool)  # in Python, true equals 1


def _any_of(rules: Sequence[Rule | None]) -> Rule | None:
    alternatives = [rule for rule in rules if rule is not None]
    if len(alternatives) < len(rules):
        return None
    words = ", or ".join(dict.fromkeys(rule.words for rule in alternatives))
    return Rule(words, lambda value: any(rule.allows(value) for rule in alternatives))

"""Bodies of JSON, and settings, as types: what does not fit is one line."""

import dataclasses
from typing import Annotated

import msgspec
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import checked, typed_fields, typed_settings

Share = Annotated[float, msgspec.Meta(gt=0.0, le=1.0)]
Name = Annotated[str, msgspec.Meta(pattern=r"\A[a-z]+\Z")]


class Part(msgspec.Struct, forbid_unknown_fields=True):
    shares: Annotated[list[Share], msgspec.Meta(min_length=1, max_length=2)]


class Whole(msgspec.Struct, rename={"flags": "import"}):
    count: int
    parts: list[Part] = []
    named: dict[Name, Part] = {}
    note: str | None = None
    flags: dict = {}


def test_a_body_that_fits_keeps_its_values():
    body = {
        "count": 3,
        "parts": [{"shares": [1, 0.5]}],
        "named": {"a": {"shares": [0.25]}},
        "import": {"any": [None]},
        "more": "is left out",
    }
    found = checked(body, Whole, "a.json")
    assert found.parts[0].shares == [1.0, 0.5]
    assert isinstance(found.parts[0].shares[0], float)
    assert found.named["a"].shares == [0.25]
    assert (found.note, found.flags) == (None, {"any": [None]})


@pytest.mark.parametrize(
    ("body", "line"),
    [
        (3, "3: expected an object"),
        ({"count": "3"}, "count: 3: expected a whole number"),
        ({"count": 1, "parts": [{}]}, "parts[0].shares: missing: expected a value"),
        (
            {"count": 1, "parts": [{"shares": [1], "x` - at `$[7]": 2}]},
            "unknown: expected no such field",
        ),
        (
            {"count": 1, "parts": [{"shares": [float("nan")]}]},
            "parts[0].shares[0]: nan: expected a number > 0.0",
        ),
        ({"count": 1, "parts": [{"shares": [10**400]}]}, "(number out of range)"),
        (
            {"count": 1, "named": {"a": {"shares": ["b"]}}},
            "named[...].shares[0]: {'a': {'shares': ['b']}}: expected a number",
        ),
        ({"count": 1, "named": {"A": {}}}, "named: {'A': {}}: expected a text match"),
    ],
)
def test_what_does_not_fit_is_one_line(body, line):
    with pytest.raises(InputError) as caught:
        checked(body, Whole, "a.json")
    assert str(caught.value).startswith("a.json: ")
    assert line in str(caught.value)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inner:
    sizes: tuple[int, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outer:
    name: str = ""
    flag: bool = False
    count: int = 1
    rate: float = 0.5
    limit: float | None = None
    pairs: tuple[tuple[float, int], ...] = ()
    inner: Inner = dataclasses.field(default_factory=Inner)


def test_values_get_the_types_of_their_fields():
    found = {"name": "a", "flag": True, "count": 3, "rate": 1, "limit": 2}
    found |= {"pairs": [[1, 2], [0.5, 3]], "inner": {"sizes": [8, 4]}}
    made = typed_settings(Outer, found)
    pairs, inner = ((1.0, 2), (0.5, 3)), Inner(sizes=(8, 4))
    assert made == Outer(
        name="a", flag=True, count=3, rate=1.0, limit=2.0, pairs=pairs, inner=inner
    )
    assert [type(made.rate), type(made.limit), type(made.pairs[0][0])] == [float] * 3
    assert typed_settings(Outer, {"limit": None}).limit is None
    assert typed_fields(Outer, {}, "") == {}
    with pytest.raises(InputError, match="rate: unknown"):
        typed_fields(Outer, {"rate": 1.0}, "", ("rate",))


@pytest.mark.parametrize(
    ("found", "says"),
    [
        ({"flag": 1}, "flag: 1: expected true or false"),
        ({"count": 2**31}, "count: 2147483648: expected numbers between"),
        ({"pairs": [[1, 2], [3]]}, "pairs: [1]: [3]: expected a list of length 2"),
        ({"inner": {"sizes": [[]]}}, "inner.sizes: [0]: []: expected a whole number"),
        ({"inner": {"size": []}}, "inner.size: unknown: expected some of sizes; did"),
        ({"flog": 1}, "flog: unknown: expected some of name, flag, count,"),
    ],
)
def test_a_setting_of_another_type_is_one_line(found, says):
    with pytest.raises(InputError) as caught:
        typed_fields(Outer, found, "file: ")
    assert str(caught.value).startswith(f"file: {says}")

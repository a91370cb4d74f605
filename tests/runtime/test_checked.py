"""Bodies of JSON as types: what does not fit is one line that names it."""

from typing import Annotated

import msgspec
import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.checked import checked

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
        ({}, "count: missing: expected a value"),
        ({"count": "3"}, "count: 3: expected a whole number"),
        ({"count": True}, "count: True: expected a whole number"),
        ({"count": 1, "note": 2}, "note: 2: expected a text or none"),
        ({"count": 1, "parts": {}}, "parts: {}: expected a list"),
        ({"count": 1, "parts": [{}]}, "parts[0].shares: missing: expected a value"),
        (
            {"count": 1, "parts": [{"shares": [1], "x` - at `$[7]": 2}]},
            "unknown: expected no such field",
        ),
        ({"count": 1, "parts": [{"shares": []}]}, "expected a list of length >= 1"),
        (
            {"count": 1, "parts": [{"shares": [1, 0]}]},
            "parts[0].shares[1]: 0: expected a number > 0.0",
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
        ({"count": "x" * 10**6}, f"count: {'x' * 80}: expected a whole number"),
    ],
)
def test_what_does_not_fit_is_one_line(body, line):
    with pytest.raises(InputError) as caught:
        checked(body, Whole, "a.json")
    assert str(caught.value).startswith("a.json: ")
    assert line in str(caught.value)


def test_an_unknown_field_is_told_the_known_ones():
    with pytest.raises(
        InputError, match=r"^a: share: unknown: expected shares; did you mean shares\?$"
    ):
        checked({"shares": [1], "share": 2}, Part, "a")

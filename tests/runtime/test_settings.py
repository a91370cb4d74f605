"""Settings from outside: of their fields' types, or one line that says which is not."""

import dataclasses

import pytest

from rcirl_jax.errors import InputError
from rcirl_jax.runtime.settings import typed_fields, typed_settings


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
        ({"name": 1}, "name: 1: expected a text"),
        ({"flag": 1}, "flag: 1: expected true or false"),
        ({"count": True}, "count: True: expected a whole number"),
        ({"count": 2**31}, "count: 2147483648: expected numbers between"),
        ({"rate": float("nan")}, "rate: nan: expected numbers between"),
        ({"rate": "1"}, "rate: 1: expected a number"),
        ({"pairs": 3}, "pairs: 3: expected a list"),
        ({"pairs": [[1, 2], [3]]}, "pairs: [1]: [3]: expected a list of length 2"),
        ({"pairs": [[1, 0.5]]}, "pairs: [0][1]: 0.5: expected a whole number"),
        ({"inner": [1]}, "inner: [1]: expected an object"),
        ({"inner": {"sizes": [[]]}}, "inner.sizes: [0]: []: expected a whole number"),
        ({"inner": {"size": []}}, "inner.size: unknown: expected some of sizes; did"),
        ({"flog": 1}, "flog: unknown: expected some of name, flag, count,"),
    ],
)
def test_a_value_of_another_type_is_one_line(found, says):
    with pytest.raises(InputError) as caught:
        typed_fields(Outer, found, "file: ")
    assert str(caught.value).startswith(f"file: {says}")

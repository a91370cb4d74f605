"""Source TOMLs are closed: what nobody reads is refused, with what it may mean."""

import re
import subprocess
import sys

import pytest

from rcirl_jax.data.formats import IMPORTERS
from rcirl_jax.data.formats.format import FORMATS
from rcirl_jax.data.formats.options import check_options
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import load_toml, spec_root
from tests.helpers.logs import packaged, refused

EVERY = pytest.mark.parametrize("name", IMPORTERS)
COMMENTED = re.compile(r"(?m)^# ([a-z]\w*) = ")  # an option that is left out


def check(name, spec):
    check_options(spec, packaged(name), FORMATS[name])


@EVERY
def test_the_packaged_options_are_known(name):
    """Also those that stand in its comments."""
    check(name, packaged(name))
    text = (spec_root() / "sources" / f"{name}.toml").read_text()
    known = {**packaged(name), **FORMATS[name].options}
    tables = {n for value in known.values() if isinstance(value, dict) for n in value}
    commented = set(COMMENTED.findall(text)) - tables - {"vx", "automated"}
    assert commented <= known.keys()


@EVERY
def test_a_misspelt_option_is_refused(name):
    for key in packaged(name):
        line = refused(check, name, {f"{key}x": packaged(name)[key]})
        assert line.startswith(f"source TOML: {key}x: unknown: expected some of ")
        assert line.endswith(f"; did you mean {key}?")


@EVERY
def test_a_misspelt_name_in_a_table_is_refused(name):
    """Unless names are free there: classes of road users, columns, models of cars."""
    form = FORMATS[name]
    for key, value in {**packaged(name), **form.options}.items():
        tables = value if isinstance(value, list) else [value]
        for table in (one for one in tables if isinstance(one, dict) and one):
            (known, example), *_ = table.items()
            spec = {key: {f"{known}x": example}}
            spec = {key: [spec[key]]} if isinstance(value, list) else spec
            if key in form.free:
                check(name, spec)
                continue
            line = refused(check, name, spec)
            assert line.startswith(f"source TOML: {key}.{known}x: unknown: expected")
            assert line.endswith(f"; did you mean {known}?")


@pytest.mark.parametrize(
    ("source", "name"), [("csv_example", "csv"), ("ngsim_metres", "ngsim")]
)
def test_other_packaged_files(source, name):
    check(name, load_toml(spec_root() / "sources" / f"{source}.toml"))


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("levelx", {"partial": "yes"}),
        ("interaction", {"map": 3}),
        ("csv", {"long_bytes": "64 MiB"}),
        ("csv", {"automated_values": "yes"}),
        ("nuplan", {"ego": {"length": "long"}}),
    ],
)
def test_types_of_options_that_a_packaged_file_leaves_out(name, option):
    with pytest.raises(InputError, match=r"expected (true or false|a )"):
        check(name, option)


def test_what_formats_say_is_cheap_to_read():
    """Their readers, and what these need, are loaded when they are asked for."""
    code = "import sys, rcirl_jax.data.formats; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    heavy = {"pyarrow", "google.protobuf", "shapely", "mcap", "tensorstore"}
    assert not loaded & {*heavy, "rcirl_jax.data.formats.waymo"}

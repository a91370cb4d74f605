"""Parts of importers that are read alone: maps, geometries, messages, frames."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.reliability.fuzz.targets import Bytes, OneFile, Target
from rcirl_jax.data.importers import geopackage, lanelet2, tfrecord
from rcirl_jax.data.importers.wire import Schema, WireError, fields, packed_sint32
from rcirl_jax.errors import InputError
from tests.data.formats import apollo, interaction, nuplan, osm, waymo


def lanelet2_target(folder: Path) -> Target:
    """Lanelet2 maps by metres and by degrees."""
    folder.mkdir(parents=True)
    metres = osm.lanelet_map(folder / "map.osm_xy", osm.in_metres, (0.0, 0.0))
    degrees = osm.lanelet_map(
        folder / "map.osm", osm.in_degrees(31, interaction.ORIGIN), (0.0, 0.0)
    )
    return OneFile(lambda file: lanelet2.read_lanelet2(file, _flat), [metres, degrees])


def _flat(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    return 1e5 * np.stack([longitude, latitude], axis=-1)


def geometry_target(folder: Path) -> Target:
    """Blobs of a GeoPackage, as a layer reads them."""

    def read(blob: bytes) -> None:
        try:
            geopackage.points_of(blob)
        except ValueError as error:
            raise InputError(f"layer: {error}: expected a geometry") from error

    line = np.array([[0.0, 0.0], [5.0, 1.0], [9.0, 1.0]])
    seeds = [nuplan.geometry(kind, line) for kind in (2, 3)]
    many = seeds[0][:40] + b"\x01\x05\0\0\0\x02\0\0\0" + 2 * seeds[0][40:]
    return Bytes(read, [("bytes", blob) for blob in (*seeds, many)], ["layer"])


def wire_target(folder: Path) -> Target:
    """Protocol buffers: fields, descriptors, packed numbers."""

    def read(data: bytes) -> None:
        view = memoryview(data)
        for part in (lambda: list(fields(view)), lambda: Schema().add(view)):
            _refuse(part)
        _refuse(lambda: packed_sint32(view))

    descriptors = [desc for _, desc in apollo.CHANNELS.values()][:3]
    seeds = [
        apollo.perception(1.0),
        apollo.localization(1.0),
        *map(_plain, descriptors),
    ]
    return Bytes(read, [("message", bytes(seed)) for seed in seeds], ["message"])


def _plain(description: object) -> bytes:
    return (
        description if isinstance(description, bytes) else apollo.message(description)
    )


def _refuse(read: Callable[[], object]) -> None:
    """Importers put the file's name before what these say."""
    try:
        read()
    except WireError:
        return


def tfrecord_target(folder: Path) -> Target:
    """The frame of TFRecord files."""
    folder.mkdir(parents=True)
    file = folder / "x.tfrecord"
    file.write_bytes(waymo.tfrecord([b"\x08\x01" * 9, b"", b"\x12\x03abc"]))
    return Target(lambda: list(tfrecord.read_records(file)), [file])

"""Parts of importers that are read alone: maps, geometries, descriptors, frames."""

import contextlib
from pathlib import Path

import numpy as np
import shapely
from google.protobuf.message import DecodeError

from benchmarks.reliability.fuzz.targets import Bytes, OneFile, Target
from rcirl_jax.data.importers.apollo import messages
from rcirl_jax.data.importers.apollo.descriptors import reading_of
from rcirl_jax.data.importers.lanelet2 import map as lanelet2
from rcirl_jax.data.importers.nuplan import geopackage
from rcirl_jax.data.readers import tfrecord
from rcirl_jax.errors import InputError
from tests.data.importers.formats import apollo, interaction, nuplan, osm, waymo


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
    shapes = (shapely.LineString, shapely.Polygon)
    seeds = [nuplan.geometry(shape, line) for shape in shapes]
    many = seeds[0][:40] + b"\x01\x05\0\0\0\x02\0\0\0" + 2 * seeds[0][40:]
    return Bytes(read, [("bytes", blob) for blob in (*seeds, many)], ["layer"])


def descriptors_target(folder: Path) -> Target:
    """Descriptors of Apollo's messages, by which sound messages are read."""
    made = {
        "localization": apollo.localization(1.0),
        "chassis": apollo.chassis(1.0),
        "perception": apollo.perception(1.0),
    }
    channels = [messages.TOPICS[topic].channels[0] for topic in made]

    def read(data: bytes) -> None:
        for (topic, message), channel in zip(made.items(), channels, strict=True):
            kind = apollo.CHANNELS[channel][0]
            # importers put the file's name before what these say
            with contextlib.suppress(DecodeError):
                reading_of(kind, data, messages.TOPICS[topic].wanted).parse(message)

    seeds = [("message", apollo.CHANNELS[channel][1]) for channel in channels]
    return Bytes(read, seeds, ["message"])


def tfrecord_target(folder: Path) -> Target:
    """The frame of TFRecord files."""
    folder.mkdir(parents=True)
    file = folder / "x.tfrecord"
    file.write_bytes(waymo.tfrecord([b"\x08\x01" * 9, b"", b"\x12\x03abc"]))
    return Target(lambda: list(tfrecord.read_records(file)), [file])

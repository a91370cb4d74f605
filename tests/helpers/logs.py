"""Logs as tests read them: recordings, or the one line that refuses them."""

import pytest

from rcirl_jax.data import importing
from rcirl_jax.data.formats import module_of, read_recordings
from rcirl_jax.data.formats.options import USER_KEYS
from rcirl_jax.data.scenes.config import CollectConfig
from rcirl_jax.errors import InputError
from rcirl_jax.runtime.specs import load_toml, spec_root


def packaged(form):
    """The options of a format's packaged TOML."""
    return load_toml(spec_root() / "sources" / f"{form}.toml")


def read(form, path, source=None, **options):
    """All recordings of an input; `options` take the place of packaged ones."""
    if not options:
        return list(read_recordings(form, path, source))
    spec = {**packaged(form), **options, USER_KEYS: sorted(options)}
    return list(module_of(form).recordings(path, spec))


def only(form, path, source=None, **options):
    """The only recording of an input."""
    (recording,) = read(form, path, source, **options)
    return recording


def refused(call, *args, **options):
    """The line with which a call refuses its input."""
    with pytest.raises(InputError) as caught:
        call(*args, **options)
    (line,) = str(caught.value).splitlines()
    return line


def edit(path, old, new, count=1):
    """Put other text where `old` stands in a file."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


def lanes_of(recording):
    """Lanes by their ids."""
    return {lane.id: lane for lane in recording.lanes}


def tracks_of(recording):
    """Tracks by their ids."""
    return {track.id: track for track in recording.tracks}


def scenes_of(recordings, min_future_s):
    """(track, frame) -> its human's stations, of all scenes; each is met once."""
    config = CollectConfig(
        require_obstacles=False, require_speed_change=False, min_future_s=min_future_s
    )
    found = {}
    for made in (importing.scenes_of(recording, config) for recording in recordings):
        for row, name in enumerate(made.vehicles):
            key = (name.rpartition(":")[2], int(made.scenes.frame[row]))
            assert key not in found, "one scene twice"
            found[key] = made.scenes.human.s[row]
    return found

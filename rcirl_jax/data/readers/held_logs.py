"""Logs of rows that fit into memory: each of their recordings is one piece."""

import dataclasses
from collections.abc import Container, Iterator

import numpy as np

from rcirl_jax.data.readers.tables.clock import after_midnight
from rcirl_jax.data.readers.tables.ledger import Ledger
from rcirl_jax.data.readers.tables.repair import Distance, once, reachable_rows


@dataclasses.dataclass(frozen=True, kw_only=True)
class Piece:
    """Rows of one minute of one recording, and of its surroundings.

    Of a minute too crowded for memory it is a window, counted by `window`.
    """

    recording: str | None  # value of the `recording` field
    number: int  # of the minute, from the recording's first
    values: dict[str, np.ndarray]  # field -> [n], t since the recording's start
    within: tuple[float, float]  # s, the minute or the window itself
    # id -> s, when the whole log first saw it, and when again after each gap
    fragments: dict[str, list[float]]
    progress: float  # share of the file's pieces up to this one
    window: int | None = None  # of the minute; None: the minute is one piece
    is_whole: bool = False  # the recording is one piece

    @property
    def label(self) -> str:
        """What names of recordings end with."""
        rest = "" if self.window is None else f".{self.window:02d}"
        return "" if self.is_whole else f"-{self.number:05d}{rest}"


class Held:
    """Rows by recording, of a log that fits into memory."""

    def __init__(
        self,
        rows: dict[str, np.ndarray],
        ledger: Ledger,
        apart: Container[str],
        places: tuple[str, str],
        distance: Distance | None = None,
        is_clock: bool = False,
    ) -> None:
        self.rows, self.ledger, self.apart, self.places = rows, ledger, apart, places
        self.distance, self.is_clock = distance, is_clock
        self._of = rows.pop("recording", None)
        self._tidied: dict[str | None, dict[str, np.ndarray]] = {}

    def recordings(self) -> list[str | None]:
        """Values of `recording`; [None] without the field."""
        return [None] if self._of is None else np.unique(self._of).tolist()

    def texts_of(self, field: str) -> list[str]:
        """All that a field of texts holds."""
        return np.unique(self.rows.get(field, [])).tolist()

    def minutes(self, recording: str | None) -> Iterator[dict[str, np.ndarray]]:
        """Field -> [n] of a recording, t as in the file."""
        if recording not in self._tidied:
            own = self.rows
            if recording is not None:
                chosen = self._of == recording
                own = {name: column[chosen] for name, column in own.items()}
            plain = str if own["id"].dtype.kind == "U" else "{:g}".format
            options = {"places": self.places, "apart": self.apart, "name_of": plain}
            if self.is_clock:
                own = {**own, "t": after_midnight(own["t"])}
            own = once(own, self.ledger, **options)
            if self.distance is not None:
                kept = reachable_rows(own, self.ledger, self.distance, plain)
                own = {name: column[kept] for name, column in own.items()}
            self._tidied[recording] = own
        yield self._tidied[recording]

    def pieces(self, recording: str | None, max_gap_s: float) -> Iterator[Piece]:
        """The recording as one piece; arguments as of `Spill.pieces`."""
        for values in self.minutes(recording):
            yield Piece(
                recording=recording,
                number=0,
                values={**values, "t": values["t"] - values["t"].min()},
                within=(-np.inf, np.inf),
                fragments={},
                progress=1.0,
                is_whole=True,
            )

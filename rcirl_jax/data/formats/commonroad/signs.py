"""Traffic signs of CommonRoad files: speed limits and stops, by country.

The ids are those of CommonRoad's own tables (`TrafficSignID...` of commonroad-io and
of its environment model), which are the ones of the countries' road traffic acts.
CommonRoad's default country and those without a table of their own use the German ids.
"""

import collections
from xml.etree.ElementTree import Element

from rcirl_jax.data.readers.xml import Fields

# the country that a file's benchmarkID begins with -> its ids
LIMITS = {
    "ARG": ("R15",),
    "AUS": ("R4-1",),
    "BEL": ("C43",),
    "ESP": ("R301",),
    "FRA": ("B14",),
    "GRC": ("P-32",),
    "HRV": ("B31",),
    "PRI": ("R2-1",),
    "RUS": ("3.24",),
    "USA": ("R2-1",),
}
STOPS = {
    "ARG": ("R27",),
    "AUS": ("R1-1",),
    "BEL": ("B5",),
    "ESP": ("R2",),
    "FRA": ("AB4",),
    "GRC": ("P-2",),
    "HRV": ("B02",),
    "PRI": ("R1-1",),
    "RUS": ("2.5",),
    "USA": ("R1-1",),
}
GERMAN_LIMITS, GERMAN_STOPS = ("274", "274.1"), ("206",)  # 274.1 begins a zone
# German ids with a number that is no upper limit: masses, sizes, ends, lower limits;
# and those of the plates below a sign, which begin with 10
OTHER_NUMBERS = ("262", "264", "265", "266", "273", "274.2", "275", "278", "310")
PLATES = "10"
COUNTRY = 3  # letters


class Signs:
    """What the signs of a file say, by the signs' ids."""

    def __init__(self, root: Element, fields: Fields, lowest: float) -> None:
        """Reads them.

        Args:
          root: of the file.
          fields: of the file.
          lowest: m/s; limits below are taken for none.
        """
        country = root.get("benchmarkID", "").removeprefix("C-")[:COUNTRY]
        limits = (*_of(LIMITS, country), *GERMAN_LIMITS)
        stops = (*_of(STOPS, country), *GERMAN_STOPS)
        self.limits: dict[str, float] = {}  # m/s
        self.stops: set[str] = set()
        self._ignored, self._lowest = 0, lowest
        self._unknown: collections.Counter[str] = collections.Counter()
        for sign in root.iterfind("trafficSign"):
            name = sign.get("id", "")
            for element in sign.iterfind("trafficSignElement"):
                kind = _plain((element.findtext("trafficSignID") or "").strip())
                value = element.find("additionalValue")
                if kind in stops:
                    self.stops.add(name)
                elif kind in limits and value is not None:
                    self._add(name, fields.number(value, f"trafficSign {name}"))
                elif value is not None and _is_unknown(kind, value):
                    self._unknown[kind] += 1

    def _add(self, name: str, limit: float) -> None:
        if limit >= self._lowest:
            self.limits[name] = limit
        else:
            self._ignored += 1

    def notes(self) -> list[str]:
        """What was ignored."""
        notes = []
        if self._ignored:
            lowest = f"{self._lowest:g} m/s"
            notes.append(f"{self._ignored} speed limits below {lowest} ignored")
        if self._unknown:
            known = self._unknown.items()
            kinds = ", ".join(f"{n} {kind[:20]}" for kind, n in known)
            count = sum(self._unknown.values())
            notes.append(
                f"{count} signs with a number, but of unknown id: {kinds[:200]}"
            )
        return notes


def _of(table: dict[str, tuple[str, ...]], country: str) -> tuple[str, ...]:
    """The ids of a country; those of all where a file names none, or Zamunda."""
    if country.isalpha() and country.isupper() and country != "ZAM":
        return table.get(country, ())
    return tuple(kind for kinds in table.values() for kind in kinds)


def _plain(kind: str) -> str:
    """An id in one spelling: r301 as R301, a Greek rho as P, 274-50 as 274."""
    plain = kind.upper().replace("\N{GREEK CAPITAL LETTER RHO}", "P")
    name, _, number = plain.partition("-")
    return name if name in GERMAN_LIMITS and number.isdigit() else plain


def _is_unknown(kind: str, value: Element) -> bool:
    """Whether nobody knows what the number on a sign means."""
    try:
        float(value.text or "")
    except ValueError:
        return False
    return kind not in OTHER_NUMBERS and not kind.startswith(PLATES)

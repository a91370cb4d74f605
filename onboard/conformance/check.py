"""Runs the cases of `cases.txt` through a program and compares what it answers.

    python onboard/conformance/check.py [--features-only | --filter] PROGRAM ...

The program is started once for each case, with the path of the weights file as its
last argument and the case on stdin. It writes the features, then the scores and, with
`--filter`, the rulings of the safety filter, as numbers between white space. Needs
Python and nothing else; README.md has the format.
Exit status: 0 all equal, 1 a difference, 2 a program that fails or a file that does.
"""

import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

CASES = Path(__file__).parent / "cases.txt"
TOLERANCE = 1e-5  # of max(1, |x|)
SECONDS = 60.0  # that a program may take for a case
# what is compared: features alone, scores too, and the safety filter too
FEATURES, SCORES, FILTER = "--features-only", "", "--filter"


class Case:
    """One case: what a program is given, and what it has to answer."""

    def __init__(self, lines: list[str]) -> None:
        words = [line.split() for line in lines]
        (self.name,), (self.weights,), self.columns = (x[1:] for x in words[:3])
        answer = lines.index("answer")
        self.given = "\n".join([*lines[3:answer], "end", ""])
        self.rows = [[float(x) for x in w[1:]] for w in words[answer + 1 : -3]]
        self.scores = [float(x) for x in words[-3][1:]]
        self.rulings = [float(x) for x in words[-2][1:]]
        (self.valid,) = (int(w[1]) for w in words if w[0] == "num_valid")
        self.times = len(self.rows) // len(self.scores)

    def features(self) -> Iterator[tuple[str, float, bool]]:
        """Place, value, and whether it counts, of every feature in order."""
        for number, row in enumerate(self.rows):
            k, t = divmod(number, self.times)
            for column, value in zip(self.columns, row, strict=True):
                place = f"features: candidate {k}, time {t}, {column}"
                yield place, value, t < self.valid

    def expected(self, parts: str = SCORES) -> list[tuple[str, float, bool]]:
        """Every number of the answer, of the parts that are asked for."""
        found = list(self.features())
        if parts != FEATURES:
            places = (f"scores: candidate {k}" for k in range(len(self.scores)))
            found += [(*x, True) for x in zip(places, self.scores, strict=True)]
        if parts == FILTER:
            for n, value in enumerate(self.rulings):
                what = ("reason", "obstacle", "time")[n % 3]
                found.append((f"rulings: candidate {n // 3}, {what}", value, True))
        return found


def read_cases(path: Path) -> list[Case]:
    """All cases of a file."""
    found: list[Case] = []
    lines: list[str] = []
    for line in path.read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        lines.append(line)
        if line == "end":
            found.append(Case(lines))
            lines = []
    return found


def answer(command: list[str], case: Case) -> list[float] | str:
    """The numbers of a program, or one line on why there are none."""
    words = [*command, str(CASES.parent / case.weights)]
    try:
        done = subprocess.run(
            words, input=case.given, capture_output=True, text=True, check=False,
            timeout=SECONDS,
        )  # fmt: skip
        if done.returncode != 0:
            said = done.stderr.strip().splitlines() or ["nothing on stderr"]
            return f"exit status {done.returncode}: {said[-1]}"
        return [float(word) for word in done.stdout.split()]
    except (OSError, subprocess.TimeoutExpired, ValueError) as error:
        return str(error).splitlines()[0]


def differences(case: Case, found: list[float], parts: str) -> list[str]:
    """A line for every number that is not what it has to be."""
    expected = case.expected(parts)
    if len(found) < len(expected):
        return [f"{len(found)} numbers: expected {len(expected)}"]
    wrong = []
    for (place, value, counts), number in zip(expected, found, strict=False):
        apart = abs(number - value) / max(1.0, abs(value))
        if counts and not (math.isfinite(apart) and apart <= TOLERANCE):
            wrong.append(f"{place}: {number:.9g}: expected {value:.9g}")
    return wrong


def main(arguments: list[str]) -> int:
    """Check one program; the exit status."""
    given = arguments[:1] in ([FEATURES], [FILTER])
    parts, command = arguments[0] if given else SCORES, arguments[given:]
    if not command:
        print("check.py: arguments: none: expected PROGRAM", file=sys.stderr)
        return 2
    cases, failed = read_cases(CASES), 0
    for case in cases:
        found = answer(command, case)
        if isinstance(found, str):
            print(f"{case.name}: {found}", file=sys.stderr)
            return 2
        wrong = differences(case, found, parts)
        failed += bool(wrong)
        for line in wrong[:5]:
            print(f"{case.name}: {line}", file=sys.stderr)
        if len(wrong) > 5:
            print(f"{case.name}: {len(wrong) - 5} more", file=sys.stderr)
    print(f"conformance: {len(cases) - failed} of {len(cases)} cases equal")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

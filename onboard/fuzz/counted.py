"""A libFuzzer program, and one last line of how many inputs it ran.

    python -m onboard.fuzz.counted LEAST build/fuzz/fuzz_load -max_total_time=600 CORPUS

What the program says is passed on; the line is on stdout, the exit status its own. A
program that says nowhere that it ran LEAST inputs is one line on stderr and exit
status 1.
"""

import re
import subprocess
import sys
from collections.abc import Iterable

DONE = re.compile(r"Done (\d+) runs in \d+ second")


def runs(lines: Iterable[str]) -> int:
    """The inputs of all fuzzers whose end is in the lines."""
    return sum(int(x[1]) for line in lines if (x := DONE.match(line)))


def main(least: int, words: list[str]) -> int:
    """Run the program; its exit status, 1 with fewer than `least` inputs."""
    said = []
    with subprocess.Popen(
        words, stderr=subprocess.PIPE, text=True, errors="replace"
    ) as process:
        for line in process.stderr or ():
            sys.stderr.write(line)
            said.append(line)
    if process.returncode != 0:
        return process.returncode
    done = runs(said)
    if done < least:
        print(
            f"error: {words[0]}: {done:,} inputs: expected {least:,}", file=sys.stderr
        )
        return 1
    print(f"fuzz: {done:,} inputs, no crash")
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:]))

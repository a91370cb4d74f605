"""A program that plans constant speed, and does what a test names in some cases.

faulty.py KIND
faulty.py CASE=KIND ...
"""

import json
import os
import sys
import time

faults = dict(word.rpartition("=")[::2] for word in sys.argv[1:])
times = json.loads(sys.stdin.readline())["times"]
hello = {"protocol": 2 if "another protocol" in sys.argv else 1, "name": "faulty"}
print(json.dumps({**hello, "answer_s": 0.5}), flush=True)
for text in sys.stdin:
    given = json.loads(text)
    kind, _, file = faults.get(given["case"], faults.get("", "")).partition(":")
    s = [given["scene"]["ego"]["v"] * t for t in times]
    answers = {
        "says error": {"error": "no way through"},
        "short": {"s": s[:17]},
        "nan": {"s": [0.0, float("nan"), *s[2:]]},
        "back": {"s": [*s[:5], s[4] - 1.0, *s[6:]]},
        "elsewhere": {"s": [x + 3.0 for x in s]},
    }
    answer = json.dumps(answers.get(kind, {"s": s}))
    if kind == "dies once" and not os.path.exists(file):
        open(file, "w").close()
        os._exit(9)
    if kind == "dies" or (kind == "dies later" and given["step"] >= 20):
        os._exit(9)
    if kind == "hangs":
        time.sleep(60.0)
    if kind == "babbles on":
        answer += "\nplanned in 3 ms"
    if kind == "endless line":
        answer = "x" * 2**21
    print(answer, flush=True)

"""A program that plans constant speed, and does what a test names in one case.

faulty.py KIND [CASE] [FILE]
faulty.py CASE=KIND ...
"""

import json
import os
import sys
import time

kind, place, file = (*sys.argv[1:], "", "")[:3]
each = dict(word.split("=") for word in sys.argv[1:] if "=" in word)
times = json.loads(sys.stdin.readline())["times"]
hello = {"protocol": 2 if kind == "another protocol" else 1, "name": "faulty"}
print(json.dumps({**hello, "answer_s": 0.5}), flush=True)
for text in sys.stdin:
    given = json.loads(text)
    s = [given["scene"]["ego"]["v"] * t for t in times]
    answer = json.dumps({"s": s})
    if each:
        kind = each.get(given["case"], "well")
    if each or given["case"] == place or not place:
        if kind == "dies":
            os._exit(9)
        if kind == "dies once" and not os.path.exists(file):
            open(file, "w").close()
            os._exit(9)
        if kind == "hangs":
            time.sleep(60.0)
        if kind == "dies later" and given["step"] >= 20:
            os._exit(9)
        if kind == "says error":
            answer = json.dumps({"error": "no way through"})
        if kind == "babbles on":
            answer += "\nplanned in 3 ms"
        if kind == "endless line":
            answer = "x" * 2**21
        if kind == "short":
            answer = json.dumps({"s": s[:17]})
        if kind == "nan":
            answer = json.dumps({"s": [0.0, float("nan"), *s[2:]]})
        if kind == "back":
            answer = json.dumps({"s": [*s[:5], s[4] - 1.0, *s[6:]]})
        if kind == "elsewhere":
            answer = json.dumps({"s": [x + 3.0 for x in s]})
    print(answer, flush=True)

"""Terms of the report, each explained in a line: the one place where they are."""

import re

from markupsafe import Markup, escape

TERMS = {
    "at-fault": "caused by the ego: it runs into somebody, or moves into their way",
    "preventable": "one of two models of a careful driver avoids it",
    "clean drives": "no own fault, red light or stop sign run, always more than 0.95 s "
    "to a collision, within the limit and on the road",
    "time to collision": "time until two bodies meet if both keep their speed",
    "nuPlan": "score of the nuPlan benchmark, 0 to 100 points: nothing with an own "
    "fault or off the road, else progress, time to collision, speed and comfort",
    "progress": "way along the road in the time of a case",
    "jerk": "change of acceleration in a second; much of it feels rough",
    "nearer to the human": "less distance along the road from what the recorded human "
    "did, over held-out drives from the same start",
    "hand-set": "the cost with weights set by hand that planners drive with today",
    "constant V": "a planner that likes all its plans alike: it knows nothing",
    "+velocity": "a planner that likes nothing but speed: it knows nothing",
    "IDM": "Intelligent Driver Model: follows the car ahead by a formula",
    "random": "candidates in random order, or weights that have learned nothing",
    "oracle": "chooses the candidate nearest to the human: the best one can do",
    "human rank": "share of the candidates that the human's own curve is ranked above",
    "top-1 FDE": "distance of the candidate ranked first from the human at the end",
    "top-3 FDE": "the least such distance among the three candidates ranked first",
    "MRR": "mean of 1 / rank of the candidate nearest to the human; 1 is best",
    "miss": "share of scenes whose first candidate ends far from the human",
    "Holm": "p values made larger because several things are tested at once",
    "margin": "largest loss that counts as none, declared before anything was driven",
    "rule of three": "what never happened in n cases happens in at most 3 / n of them",
    "gamma": "how much each time of a plan counts",
    "p": "how often chance alone would make a difference as large",
}
# whole words, the longer of two that begin alike
_WORDS = re.compile(
    "|".join(
        rf"(?<![\w+|-]){re.escape(term)}(?![\w-])"
        for term in sorted(TERMS, key=len, reverse=True)
    ),
    re.IGNORECASE,
)
_MEANINGS = {term.lower(): meaning for term, meaning in TERMS.items()}


def explained(text: object) -> Markup:
    """A text with its terms marked as `<abbr>`; what is `Markup` stays as it is."""
    if isinstance(text, Markup):
        return text
    words, found, at = str(text), Markup(""), 0
    for term in _WORDS.finditer(words):
        found += escape(words[at : term.start()])
        found += Markup('<abbr title="{}">{}</abbr>').format(
            _MEANINGS[term[0].lower()], term[0]
        )
        at = term.end()
    return found + escape(words[at:])

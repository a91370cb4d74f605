"""May this reward replace that driver? `decision` asks the checks and answers.

Margins and rules are in `types` and `checks`; `words` says the verdict in a sentence;
`errors` measures how often the gate is wrong about the drivers of `pairs`.
"""

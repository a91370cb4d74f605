"""May this reward replace that driver? `verdict.judge` asks the checks and answers.

Margins and results are in `types`, the rules in `checks`, every word in `words`.
"""

"""May this reward replace that driver? `verdict.judge` runs the checks and answers.

Margins and results are in `types`, every word is in `words`.
"""

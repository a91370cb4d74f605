"""A sweep's folder: `run.py` trains and resumes, `folder.py` says what lies in it.

`search.py` lets Optuna propose what is trained, `choice.py` scores the members and
chooses, `result.py` reads what came of it.
"""

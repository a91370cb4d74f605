"""A sweep's folder: `run.py` trains and resumes, `folder.py` says what lies in it.

`choice.py` scores the members and chooses, `result.py` reads what came of it.
"""

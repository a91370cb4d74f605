"""Several tuning runs on one page: `runs.py` reads a run's folder, `page.py` draws."""

"""The report of a tuning run: verdict, tables, features."""

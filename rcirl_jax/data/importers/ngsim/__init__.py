"""NGSIM trajectory tables: `reader`, and `map` for the lanes of each site."""

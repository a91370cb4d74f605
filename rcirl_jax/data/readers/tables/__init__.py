"""Tables: text of any layout, compressed or not, Parquet and Feather.

`table` is the reader; `streams` gives the text of a file, `text` says how it is written
and cuts it into columns, `columnar` reads Parquet and Feather, `cells` turns cells into
numbers, `rows` counts and drops rows.
"""

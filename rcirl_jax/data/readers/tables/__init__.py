"""Tables: text of any layout, compressed or not, Parquet and Feather.

`table` is the reader; `streams` gives the text, `layout` says how it is written,
`text_rows` and `columnar` the columns, `cells` their numbers, `ledger` and `repair`
what is dropped.
"""

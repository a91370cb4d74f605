"""Pictures and pages. Reads results, computes nothing that decides.

`pages` renders the templates and explains terms, `style` is one look for all, `charts`
are drawn inline. `data_page` shows an import (`scene` one recorded scene),
`tuning_page` a run (`features` and `frames` what the reward wants), `compare` several
runs; `replays` drives cases again, `player` shows them.
"""

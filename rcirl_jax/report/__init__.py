"""Pictures and pages. Reads results, computes nothing that decides.

`markup` and `html` escape and join, `style` is one look for all, `charts` and `plots`
are drawn inline and by matplotlib; a folder for each kind of page.
"""

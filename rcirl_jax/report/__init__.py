"""Pictures and pages. Reads results, computes nothing that decides.

`pages` renders the templates, `style` is one look for all, `charts` are drawn inline,
`glossary` explains terms; a folder for each kind of page.
"""

"""Show a run on an interactive page, served on loopback or exported as files.

Python describes the run (`view`, `diagram`, `orbits`), computes live requests (`live`) and serves both
(`server`). `page/` has the page's sources, `static/` the files built from them.
"""

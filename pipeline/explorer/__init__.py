"""The explorer: a page on which one sees a run, served on loopback or exported as files.

Python says what stands in a run (`view`, `diagram`, `orbits`), computes what the page asks for while one
watches (`live`) and serves both (`server`); `page/` has the page's sources, `static/` what is built of them.
"""

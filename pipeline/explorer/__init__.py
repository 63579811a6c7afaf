"""Show a run on an interactive web page, served on this machine only or exported as files.

`data` reads the run, `live` computes while the user watches, `serving` answers the page's requests, and `copies`
exports pages that need no server. `page/` has the page's sources, `static/` the files built from them.
"""

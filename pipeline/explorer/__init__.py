"""Show a run on an interactive web page, served on this machine, in a notebook, or exported as files.

`answers` lists what a page can request and `live` computes while the user watches; `server` and `connection` carry
requests and answers, and `copies` exports pages that hold the answers. `data` reads the run. `page/` has the page's
sources, `static/` the files built from them.
"""

from __future__ import annotations


class RequestError(ValueError):
    """Raised if a page requests what does not exist or cannot be computed; the page shows the message.

    `job` is the ``id`` of the live message, if that could be read.
    """

    def __init__(self, sentence: str, job: int | None = None) -> None:
        super().__init__(sentence)
        self.job = job

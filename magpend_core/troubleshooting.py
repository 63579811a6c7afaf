"""End messages with the section of the page of troubleshooting that explains them."""

from __future__ import annotations

PAGE = "docs/troubleshooting.md"


def see(topic: str) -> str:
    """Return a reference to a section of the page, in brackets, for the end of a message.

    Parameters
    ----------
    topic
        Anchor of the section, such as ``step-limit``. A test checks that the page has it.
    """
    return f"(see {PAGE}#{topic})"

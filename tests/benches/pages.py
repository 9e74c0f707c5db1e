"""A strict parser of the pages that the program writes."""

from __future__ import annotations

from html.parser import HTMLParser

_LOADS = ("src", "href", "srcset", "data")


class Page(HTMLParser):
    """What a page contains. It refuses tags that do not match."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text = ""

    def addresses(self) -> list[str]:
        """Return what it refers to or loads."""
        return [value or "" for name, value in self.attributes if name in _LOADS]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag != "meta":
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def parsed(text: str) -> Page:
    """Return a page, all of whose tags match."""
    page = Page()
    page.feed(text)
    page.close()
    assert page.open == []
    return page

"""Texts in tables: as they are where that brings them back, else quoted and escaped as in JSON."""

import json
import re

#: Blanks that no reader takes away inside a text, though Python calls them not printable.
BLANKS = "\u00a0\u3000"


def written(text: str) -> str:
    """A text for a cell or a header line: itself, or in quotes with \\n, \\t, \\" and \\u escapes."""
    plain = text == text.strip() and text and is_printable(text) and text[-1] not in ",;" and not _quoted(text)
    return text if plain else _escaped(text)


def read(text: str) -> str:
    """The text that `written` wrote; any other without the blanks around it."""
    text = text.strip()
    if _quoted(text):
        try:
            found = json.loads(text)
        except ValueError:
            return text
        return found if isinstance(found, str) else text
    return text


def is_printable(text: str) -> bool:
    """True for a text without control characters, line separators and characters that no encoding holds."""
    return "\ufffd" not in text and text.translate(dict.fromkeys(map(ord, BLANKS), " ")).isprintable()


def words(text: str) -> list[str]:
    """Words between blanks, commas or semicolons; those in quotes as `written` writes them."""
    return [read(word) for word in re.findall(r'"(?:[^"\\]|\\.)*"|[^\s,;]+', text)]


def word(text: str) -> str:
    """A text as one of `words`."""
    plain = words(text) == [text] and is_printable(text) and '"' not in text
    return text if plain else _escaped(text)


def _escaped(text: str) -> str:
    return "".join(c if is_printable(c) else json.dumps(c)[1:-1] for c in json.dumps(text, ensure_ascii=False))


def _quoted(text: str) -> bool:
    return len(text) > 1 and text[0] == text[-1] == '"'

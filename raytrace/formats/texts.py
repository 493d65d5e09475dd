"""Texts in tables: as they are where that brings them back, else quoted and escaped as in JSON."""

import json

#: Blanks that no reader takes away inside a text, though Python calls them not printable.
BLANKS = "\u00a0\u3000"


def written(text: str) -> str:
    """A text for a cell or a header line: itself, or in quotes with \\n, \\t, \\" and \\u escapes."""
    plain = text == text.strip() and text and is_printable(text) and text[-1] not in ",;" and not _quoted(text)
    if plain:
        return text
    escaped = json.dumps(text, ensure_ascii=False)
    return "".join(c if is_printable(c) else json.dumps(c)[1:-1] for c in escaped)


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
    return text.translate(dict.fromkeys(map(ord, BLANKS), " ")).isprintable()


def _quoted(text: str) -> bool:
    return len(text) > 1 and text[0] == text[-1] == '"'

"""Text from outside as it may be shown and stored: addresses without credentials, control characters escaped."""

from __future__ import annotations

import re

# Also with the single slash that a path leaves of `//`. A user name or a password may have any character but a space.
_USER = re.compile(r"\b([A-Za-z][A-Za-z0-9+.-]+:/{1,2})\S*@")
_ADDRESS = re.compile(r"\b[A-Za-z][A-Za-z0-9+.-]+:/{1,2}\S+")
_SECRET = re.compile(
    r"((?:password|passwd|pass|pwd|token|secret|signature|api_?key|auth)=)[^&;/\s'\"`]+", re.IGNORECASE
)


def without_credentials(text: str) -> str:
    """Return the text with the user, the password and the tokens of addresses such as rtsp://user:password@host left
    out."""
    if ":/" not in text:
        return text
    return _ADDRESS.sub(lambda found: _SECRET.sub(r"\1***", found[0]), _USER.sub(r"\1", text))


def printable(text: str) -> str:
    """Return the text with control characters, line ends and lone surrogates escaped."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def is_unicode(text: str) -> bool:
    """Return True without lone surrogates, which file names in other encodings have."""
    return not any("\ud800" <= character <= "\udfff" for character in text)

"""Credentials that URLs hold, and that must reach neither files nor screens."""

import re

# The user and the password of a URL; a secret key may hold a slash, which belongs percent-encoded, and often is not.
_USER = re.compile(r"(?<=://)(?:[^/?#\s]*|[^/?#\s:]*:[^@\s]*)@")
_CREDENTIAL = r"(?:sig|[^=&?\s]*(?:key|secret|token|passw|credential|signature)[^=&?\s]*)=[^&#\s'\"]*"
_FIRST_PARAMETER = re.compile(rf"\?{_CREDENTIAL}(&)?", re.IGNORECASE)
_LATER_PARAMETER = re.compile(rf"&{_CREDENTIAL}", re.IGNORECASE)


def redact(text: str) -> str:
    """Return the text with its URLs freed of user names, passwords and query parameters that hold credentials.

    The rest of a URL is valid: with credentials from the environment it leads to the same folder.
    """
    text = _LATER_PARAMETER.sub("", _USER.sub("", text))
    return _FIRST_PARAMETER.sub(lambda found: "?" if found[1] else "", text)

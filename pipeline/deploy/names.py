"""Names of signals as they may stand in C and Python."""

import re


def identifier(name: str) -> str:
    """`name` in capitals, with _ for what no identifier may hold."""
    return re.sub(r"\W", "_", name, flags=re.ASCII).upper()

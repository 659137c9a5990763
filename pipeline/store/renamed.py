"""Old names of parameters, columns and metrics -> today's, so that files of earlier versions are read and their users told."""

# dotted keys of params.yaml and params.expert.yaml; a key stands for all below it
PARAMETERS: dict[str, str] = {}

# (table, column) -> column
COLUMNS: dict[tuple[str, str], str] = {}

# dotted keys of reports/metrics/<stage>.json, the stage first; a key stands for all below it
METRICS: dict[str, str] = {}


def renamed(key: str, table: dict[str, str]) -> str:
    """Today's name of a dotted key: the longest old name that it begins with is replaced; a key that nobody renamed stays.

    Example: renamed("a.b.c", {"a.b": "a.d"}) is "a.d.c".
    """
    parts = key.split(".")
    for end in range(len(parts), 0, -1):
        old = ".".join(parts[:end])
        if old in table:
            return ".".join([table[old], *parts[end:]])
    return key

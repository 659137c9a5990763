"""Short digests by which two pages can be told to be of one run."""

from pipeline.report.shared.sources import Sources, digest


def hashes(sources: Sources) -> list[tuple[str, str]]:
    """(what, the first eight digits of its SHA-256)."""
    data, figures = (
        next((s.sha256 for path, s in sources.read.items() if path.endswith(end)), "missing")
        for end in ("ingest/record.parquet", "evaluate_temperature/cases.parquet")
    )
    certificate = next((s.sha256 for s in sources.source("certificate")), "")
    return [
        *([("certificate", certificate[:8])] if certificate else []),
        ("data", data[:8]),
        ("parameters", digest(sources.declared.everything)[:8]),
        ("code", sources.code[:8]),
        ("cases", figures[:8]),
    ]

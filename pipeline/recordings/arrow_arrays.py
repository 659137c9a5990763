"""Arrow's columns as numpy arrays. (Arrow's own to_numpy and fill_null would load pandas, which takes
longer.)"""

import numpy as np
import pyarrow as pa


def numbers(column: pa.Array, kind: type) -> np.ndarray:
    """The values (n,) of a column of `kind`, NaN for null. Without null they are the column's memory."""
    valid, content = column.buffers()
    if content is None:
        return np.empty(0, kind)
    values = np.frombuffer(content, kind)[column.offset : column.offset + len(column)]
    if not column.null_count:
        return values
    bits = np.unpackbits(np.frombuffer(valid, np.uint8), bitorder="little", count=column.offset + len(column))
    return np.where(bits[column.offset :].astype(bool), values, np.nan)

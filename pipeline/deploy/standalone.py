"""What stands in an exported Python file in place of a function that needs more than numpy.

`_triangular` refuses references that move: they need a Schur form.
"""

import numpy as np


def _triangular(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """S, V with F = V S V* of a constant reference. Raises ValueError for one that moves."""
    if len(F) > 1:
        raise ValueError(
            f"expected a constant reference but found one of {len(F)} states; an exported controller is "
            "given new constant references, sample by sample"
        )
    return F + 0j, np.eye(1) + 0j

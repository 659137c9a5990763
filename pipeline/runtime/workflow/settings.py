"""Section of the params files that the stage export_controllers reads."""

from pydantic import Field

from pipeline.store.params import Section


class ExportControllers(Section):
    """Section `export_controllers`: the seed of what the certificate draws, how many plants of the spread it
    tries, and how often it resamples the record for the bands of the gains."""

    seed: int = Field(ge=0, le=2**31)
    plants: int = Field(ge=20, le=100_000)
    resamples: int = Field(ge=20, le=10_000)

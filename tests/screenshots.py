"""Pictures of page one and of the viewer for the README, taken of the pages as they are in a headless
Chromium: `./run --group dev python -m tests.screenshots`, after a run."""

import shutil
from pathlib import Path
from typing import NamedTuple


class Shot(NamedTuple):
    """A page, the file that its picture becomes, and the screen in px."""

    page: str
    file: str
    width: int
    height: int


SHOTS = (Shot("index", "screenshot.png", 1280, 800), Shot("viewer", "screenshot_viewer.png", 1280, 800))
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def take(folder: Path) -> list[Path]:
    """Writes the pictures beside the pages of `folder` and returns their paths. Raises ValueError where a
    page or the browser is missing."""
    for shot in SHOTS:
        if not (folder / f"{shot.page}.html").exists():
            raise ValueError(f"{folder}/{shot.page}.html: expected the page, found none; run ./run dvc repro")
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise ValueError(f"expected one of {', '.join(BROWSERS)}, found none; install Chromium")
    # a package of the group dev
    from playwright.sync_api import sync_playwright

    taken = []
    with sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=browser, args=["--no-sandbox", "--disable-gpu"])
        for shot in SHOTS:
            page = started.new_page(
                viewport={"width": shot.width, "height": shot.height},
                color_scheme="light",
                reduced_motion="reduce",
            )
            page.goto((folder / f"{shot.page}.html").resolve().as_uri())
            page.wait_for_load_state("networkidle")
            page.screenshot(path=folder / shot.file)
            taken.append(folder / shot.file)
        started.close()
    return taken


if __name__ == "__main__":
    print("written:", *take(Path("reports")))

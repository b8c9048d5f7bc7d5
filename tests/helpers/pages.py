"""Pages of runs, in a browser and out of one."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


def browser_programs() -> tuple[str, str] | None:
    """Chromium, or Chrome, and its driver; None where one is not installed."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    return None if browser is None or driver is None else (browser, driver)


def resize(driver: Any, width: int) -> None:
    """Give a browser a width [pixels], that of a telephone below 500."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)


@contextmanager
def opened(page: Path, profile: Path, width: int = 1280) -> Iterator[Any]:
    """The driver of a browser that has opened a page."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    programs = browser_programs()
    assert programs is not None
    options = webdriver.ChromeOptions()
    options.binary_location = programs[0]
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(programs[1]))
    try:
        resize(driver, width)
        driver.get(page.resolve().as_uri())
        yield driver
    finally:
        driver.quit()

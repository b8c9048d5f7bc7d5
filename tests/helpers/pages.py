"""Pages of runs, in a browser and out of one."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",  # 3-D without a graphics card
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


@contextmanager
def opened(page: Path, profile: Path, width: int = 1280) -> Iterator[Any]:
    """The driver of a browser that has opened a page and drawn all of it, or given up."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service
    from selenium.webdriver.support.ui import WebDriverWait

    programs = browser_programs()
    assert programs is not None
    options = webdriver.ChromeOptions()
    options.binary_location = programs[0]
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(programs[1]))
    try:
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        driver.get(page.resolve().as_uri())
        ended = "return 'drawn' in document.documentElement.dataset || !document.getElementById('trouble').hidden"
        WebDriverWait(driver, 60).until(lambda one: one.execute_script(ended))
        yield driver
    finally:
        driver.quit()


def figures_of(page: str) -> dict[str, Any]:
    """The figures that a page holds."""
    (text,) = re.findall(r'<script type="application/json" id="figures">(.*?)</script>', page, re.DOTALL)
    return dict(json.loads(text, parse_constant=lambda name: 1 / 0))  # NaN is no JSON

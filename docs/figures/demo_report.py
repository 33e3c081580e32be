"""The head of the demo's report, as Chromium shows it: docs/images/demo_report.png.

    python docs/figures/demo_report.py

It needs a Chromium and playwright (the test tools), so `make docs-figures` leaves it out.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

PICTURE = Path(__file__).resolve().parents[1] / "images" / "demo_report.png"
NAMES = ("chromium", "chromium-browser", "google-chrome")
SIZE = {"width": 1100, "height": 1560}

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as started:
        environment = {**os.environ, "COLUMNS": "100"}
        demo = [sys.executable, "-m", "elastocal", "demo", "-q"]
        subprocess.run(demo, cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
        found = next(filter(None, map(shutil.which, NAMES)), None)
        browser = started.chromium.launch(executable_path=found, args=["--no-sandbox"], timeout=0)
        page = browser.new_page(viewport=SIZE)
        page.goto((Path(folder) / "demo_out" / "report.html").as_uri(), timeout=0)
        page.screenshot(path=PICTURE, timeout=0)
        browser.close()
    Image.open(PICTURE).convert("RGB").quantize(200).save(PICTURE, optimize=True)

"""The browser that tests of the page drive."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.async_api import Locator

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
BROWSER = ("--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking")
FEW_FRAMES = """
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 100);
window.cancelAnimationFrame = clearTimeout;
"""
"""To run in a page before its own scripts: ten frames a second. Without a graphics card sixty take a whole
core while robots move or their poses are noisy, and make others late."""


async def press(part: Locator) -> None:
    """Press the mouse on a part of the page, and not on what came to its place after the pointer."""
    mouse = part.page.mouse
    await part.hover()
    await mouse.down()
    while not await part.evaluate("part => part.matches(':active')"):
        await mouse.up()
        await part.hover()
        await mouse.down()

"""Accessibility: keyboard, screen reader, phone and dark theme; and screenshots."""

import os
import pathlib

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import expect

from browser import URL, Console, frame

SCREENSHOTS = os.environ.get("SCREENSHOTS")


class Access(Console):
    def test_axe_finds_no_serious_violation_in_any_view(self):
        axe = Axe()
        for scheme in ("light", "dark"):
            page = self.page(color_scheme=scheme, reduced_motion="reduce")
            for view, address in self.views().items():
                with self.subTest(view=view, scheme=scheme):
                    page.goto(f"{URL}/{address}")
                    self.settled(page, view)
                    if view == "try":
                        page.set_input_files("#try-file", frame(9))
                        expect(page.locator("main .badge")).to_be_visible()
                    page.wait_for_timeout(300)
                    found = axe.run(page).response["violations"]
                    grave = [(one["id"], [node["html"][:160] for node in one["nodes"][:3]]) for one in found
                             if one["impact"] in ("serious", "critical")]
                    self.assertEqual(grave, [])
            page.context.close()
        page = self.page(key=None)
        expect(page.locator("#sign-in")).to_be_visible()
        self.assertEqual([one["id"] for one in axe.run(page).response["violations"] if one["impact"] in ("serious", "critical")], [])

    def test_a_phone_scrolls_only_vertically(self):
        page = self.page(width=360, height=740, has_touch=True, is_mobile=True)
        for view, address in self.views().items():
            with self.subTest(view=view):
                page.goto(f"{URL}/{address}")
                self.settled(page, view)
                self.assertLessEqual(page.evaluate("document.documentElement.scrollWidth"), 360)

    def test_the_keyboard_reaches_the_main_controls(self):
        page = self.page("#/jobs")
        self.settled(page, "jobs")
        page.keyboard.press("Tab")
        expect(page.get_by_text("Skip to the content")).to_be_focused()
        page.keyboard.press("Enter")
        expect(page.locator("main")).to_be_focused()
        page.locator("table.jobs a").first.focus()
        page.keyboard.press("Enter")
        self.settled(page, "job")
        expect(page.locator("main")).to_be_focused()
        expect(page).to_have_title("Job " + page.locator("h1 code").inner_text() + " · whereabouts")
        page.get_by_role("button", name="Next").focus()
        page.keyboard.press("Enter")
        expect(page.get_by_role("button", name="Next")).to_be_focused()
        page.go_back()
        self.settled(page, "jobs")

    @classmethod
    def screenshot(cls, page, name):
        page.screenshot(path=pathlib.Path(SCREENSHOTS) / f"console-{name}.png")

    def test_screenshots_for_the_readme(self):
        if not SCREENSHOTS:
            self.skipTest("SCREENSHOTS is not set")
        for scheme in ("light", "dark"):
            page = self.page(color_scheme=scheme, reduced_motion="reduce", width=1280, height=860)
            for view, address in self.views().items():
                page.goto(f"{URL}/{address}")
                self.settled(page, view)
                if view == "try":
                    page.set_input_files("#try-file", frame(1))
                    expect(page.locator("main .badge.succeeded")).to_be_visible()
                page.wait_for_timeout(800)
                self.screenshot(page, f"{view}-{scheme}")
        page = self.page(width=390, height=844, device_scale_factor=2, has_touch=True, is_mobile=True, reduced_motion="reduce")
        for view, address in self.views().items():
            page.goto(f"{URL}/{address}")
            self.settled(page, view)
            page.wait_for_timeout(500)
            self.screenshot(page, f"{view}-phone")

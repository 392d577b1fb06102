"""A browser with the console, and the checks that apply to every page that a test opens."""

import json
import os
import pathlib
import time
import unittest
import urllib.request

from playwright.sync_api import expect, sync_playwright

URL = os.environ["URL"]
TOWN = pathlib.Path(os.environ["TOWN"])
KEYS = {role: json.loads((pathlib.Path(os.environ["KEYS"]) / f"{role}.json").read_text())["token"]
        for role in ("admin", "robot")}
MARKUP = "<img src=x onerror=\"window.pwned=1\">"

WATCH = """
addEventListener("securitypolicyviolation", (event) => violated(event.violatedDirective + " " + event.blockedURI));
"""

expect.set_options(timeout=15_000)


def frame(number=0):
    return TOWN / "frames" / f"frame-{number:04}.jpg"


def call(method, path, body=None, media_type="application/json"):
    """Calls the API as admin."""
    if isinstance(body, dict):
        body = json.dumps(body).encode()
    headers = {"Authorization": f"Bearer {KEYS['admin']}", "Content-Type": media_type}
    request = urllib.request.Request(URL + path, body, headers, method=method)
    with urllib.request.urlopen(request, timeout=60) as answer:
        text = answer.read()
    return json.loads(text) if text else None


def localize(number=0, refine="async"):
    return call("POST", f"/localize?map=town&refine={refine}", frame(number).read_bytes(), "image/jpeg")


class Console(unittest.TestCase):
    """A test case whose pages are signed in by default."""

    @classmethod
    def setUpClass(cls):
        cls.playwright = sync_playwright().start()
        # Chromium cannot use its sandbox as root.
        cls.chromium = cls.playwright.chromium.launch(executable_path=os.environ["CHROMIUM"], args=["--no-sandbox"])

    @classmethod
    def tearDownClass(cls):
        cls.chromium.close()
        cls.playwright.stop()

    def setUp(self):
        self.violations = []
        self.errors = []

    def tearDown(self):
        for page in getattr(self, "pages", []):
            if not page.is_closed():
                self.assertIsNone(page.evaluate("window.pwned ?? null"), "injected script ran")
                page.context.close()
        self.assertEqual(self.violations, [], "the content security policy was violated")
        self.assertEqual(self.errors, [], "the browser's console has errors")

    def page(self, path="", key="admin", width=1280, height=800, **options):
        """Opens a page in a new browser context."""
        context = self.chromium.new_context(viewport={"width": width, "height": height}, **options)
        context.expose_function("violated", lambda what: self.violations.append(what))
        context.add_init_script(WATCH)
        if key:
            # Only once, so that signing out lasts.
            context.add_init_script(f"""if (location.protocol !== "about:" && !sessionStorage.getItem("test")) {{
                sessionStorage.setItem("test", "1"); sessionStorage.setItem("whereabouts-key", "{KEYS[key]}"); }}""")
        page = context.new_page()
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        # Failed requests are logged there too; the tests check their effect instead.
        page.on("console", lambda said: self.errors.append(said.text)
                if said.type == "error" and "Failed to load resource" not in said.text else None)
        self.pages = [*getattr(self, "pages", []), page]
        page.goto(f"{URL}/{path}")
        return page

    def until_read(self):
        """Waits until the text in all images of the town is read."""
        until = time.monotonic() + 120
        while call("GET", "/maps/town")["texts"]["waiting"]:
            self.assertLess(time.monotonic(), until, "the images of the town are not read")
            time.sleep(0.1)

    def ended_job(self):
        return call("GET", "/jobs?state=succeeded&limit=1")["jobs"][0]

    def views(self):
        """The URL of each view, with content to show."""
        job = self.ended_job()["id"]
        return {"jobs": "#/jobs", "job": f"#/jobs/{job}", "maps": "#/maps", "map": f"#/maps/town?query={job}",
                "try": "#/try", "health": "#/health"}

    def until(self, page, expression):
        """Waits until an expression is true; the driver's own method needs `eval`, which the policy forbids."""
        for _ in range(150):
            found = page.evaluate(expression)
            if found:
                return found
            page.wait_for_timeout(100)
        return self.fail(f"did not become true: {expression}")

    def settled(self, page, view):
        """Waits until a view shows its main content."""
        sign = {"jobs": "table.jobs tbody tr", "job": ".answer .picture.here", "maps": ".cards li", "map": ".images button",
                "try": ".drop", "health": ".stats .value"}[view]
        page.locator(sign).first.wait_for()

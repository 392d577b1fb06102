"""The systemd units: accepted by systemd, hardened, and with settings that exist."""

import re
import shutil
import subprocess
import unittest

from files import (
    BINARY,
    DEFAULTS,
    ROOT,
    SCRATCH,
    check_settings,
    drain_times,
    read,
    report,
    seconds,
    settings_in_force,
)

UNIT = "deploy/systemd/whereabouts.service"
WORKER = "deploy/systemd/whereabouts-worker.service"
# Maximum exposure on the scale of systemd-analyze, from 0.0 (safe) to 10.0. A network server cannot have less than 1.
EXPOSURE = 2.0


def lines(unit):
    return re.findall(r"^(\w+)=(.*)$", read(unit), flags=re.M)


class Unit(unittest.TestCase):
    UNIT = UNIT

    def setUp(self):
        self.lines = lines(self.UNIT)
        self.of = dict(self.lines)

    def test_its_settings_exist(self):
        check_settings(self, self.UNIT, "deploy/systemd/whereabouts.env")
        given = dict(value.split("=", 1) for name, value in self.lines if name == "Environment")
        state = f"/var/lib/{self.of['StateDirectory']}"
        given = {name: value.replace("%S", "/var/lib") for name, value in given.items()}
        file = dict(re.findall(r"^(WHEREABOUTS_\w+)=(.*)$", read("deploy/systemd/whereabouts.env"), flags=re.M))
        settings = settings_in_force(given | file)
        self.assertEqual(settings["data"]["dir"], state)
        self.assertTrue(settings["model"]["assets"].startswith(state))
        report(f"{self.UNIT}: `whereabouts config` accepts its settings combined with whereabouts.env")

    def test_it_allows_enough_time_to_drain_and_enough_connections(self):
        self.assertGreater(seconds(self.of["TimeoutStopSec"]), drain_times())
        self.assertGreater(int(self.of["LimitNOFILE"]), DEFAULTS["server"]["max_connections"])
        self.assertIn(f"u {self.of['User']} ", read("deploy/systemd/whereabouts.sysusers"))

    @unittest.skipUnless(shutil.which("systemd-analyze"), "systemd-analyze is not installed")
    def test_systemd_accepts_it_and_rates_it_hardened(self):
        unit = SCRATCH / self.UNIT.rsplit("/", 1)[1]
        unit.write_text(read(self.UNIT).replace("/usr/bin/whereabouts", BINARY))
        ran = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
        self.assertEqual((ran.returncode, ran.stderr), (0, ""))
        rate = [
            "systemd-analyze",
            "security",
            "--offline=true",
            "--no-pager",
            f"--threshold={EXPOSURE * 10:.0f}",
            ROOT / self.UNIT,
        ]
        ran = subprocess.run(rate, capture_output=True, text=True, check=False)
        if "unrecognized option" in ran.stderr or "Unknown" in ran.stderr:
            self.skipTest("this systemd-analyze cannot rate a file")
        self.assertEqual(ran.returncode, 0, ran.stdout.strip().splitlines()[-1:] or ran.stderr)
        [level] = re.findall(r"exposure level .*: ([\d.]+)", ran.stdout)
        report(f"{self.UNIT}: accepted by systemd-analyze verify; exposure {level} of 10, at most {EXPOSURE}")


class Worker(Unit):
    UNIT = WORKER

    def test_it_is_hardened_like_the_server_and_migrates_first(self):
        own = {
            "Description",
            "ExecStartPre",
            "ExecStart",
            "StateDirectory",
            "WorkingDirectory",
            "Environment",
        }
        of_server = [line for line in lines(UNIT) if line[0] not in own]
        self.assertEqual([line for line in self.lines if line[0] not in own], of_server)
        self.assertEqual(self.of["ExecStartPre"], "/usr/bin/whereabouts migrate")
        self.assertRegex(self.of["ExecStart"], r"^/usr/bin/whereabouts worker --listen 127\.0\.0\.1:\d+$")
        self.assertNotIn(DEFAULTS["server"]["listen"], self.of["ExecStart"], "the port of a server on the same machine")


if __name__ == "__main__":
    unittest.main()

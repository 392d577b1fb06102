"""The unit of systemd: taken by systemd, as closed as it can be, and with settings that exist."""

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
    seconds,
    settings_in_force,
    told,
)

UNIT = "deploy/systemd/whereabouts.service"
WORKER = "deploy/systemd/whereabouts-worker.service"
# On the scale of systemd-analyze, from 0.0 (closed) to 10.0. A server on the network cannot have less than 1.
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
        told(f"{self.UNIT}: `whereabouts config` takes its settings together with whereabouts.env")

    def test_it_waits_for_the_end_and_leaves_room_for_connections(self):
        self.assertGreater(seconds(self.of["TimeoutStopSec"]), drain_times())
        self.assertGreater(int(self.of["LimitNOFILE"]), DEFAULTS["server"]["max_connections"])
        self.assertIn(f"u {self.of['User']} ", read("deploy/systemd/whereabouts.sysusers"))

    @unittest.skipUnless(shutil.which("systemd-analyze"), "systemd-analyze is not installed")
    def test_systemd_takes_it_and_finds_it_closed(self):
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
            self.skipTest("this systemd-analyze rates no file")
        self.assertEqual(ran.returncode, 0, ran.stdout.strip().splitlines()[-1:] or ran.stderr)
        [level] = re.findall(r"exposure level .*: ([\d.]+)", ran.stdout)
        told(f"{self.UNIT}: taken by systemd-analyze verify; exposure {level} of 10, at most {EXPOSURE}")


class Worker(Unit):
    UNIT = WORKER

    def test_it_is_as_closed_as_the_server_and_migrates_first(self):
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
        self.assertNotIn(DEFAULTS["server"]["listen"], self.of["ExecStart"], "the port of a server beside it")


if __name__ == "__main__":
    unittest.main()

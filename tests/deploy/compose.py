"""Checks shared by all Compose files, and access to the image that they run."""

import re
import subprocess

import yaml
from compose_spec import PyCompose
from files import DEPLOY, ROOT, check_settings, documents, read, report


def instructions():
    """The instructions of the last stage of the Dockerfile, by name."""
    text = re.sub(r"\\\n\s*", "", re.sub(r"^#.*\n", "", read("Dockerfile"), flags=re.M))
    lines = re.findall(r"^([A-Z]+) (.*)$", text[text.rindex("\nFROM ") :], flags=re.M)
    return {name: [rest for other, rest in lines if other == name] for name, _ in lines}


def image_environment():
    return dict(re.findall(r"(\w+)=(\S+)", " ".join(instructions()["ENV"])))


def with_variables(text):
    """Substitutes the default of each variable, and a placeholder for each required one."""
    text = re.sub(r"\$\{(\w+):-([^}]*)\}", r"\2", text)
    return re.sub(r"\$\{(\w+):\?[^}]*\}", lambda found: f"given-{found[1].lower()}", text)


def required(text):
    """The required variables."""
    return set(re.findall(r"\$\{(\w+):\?", text))


def has_docker_compose():
    try:
        ran = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
        return ran.returncode == 0
    except FileNotFoundError:
        return False


class ComposeFile:
    """Tests of `FILE`, with the services' profiles in `PROFILES`."""

    FILE, PROFILES = None, None

    def setUp(self):
        self.text = with_variables(read(self.FILE))
        self.file = yaml.safe_load(self.text)
        self.services = self.file["services"]

    def test_it_conforms_to_the_compose_specification(self):
        # Dumped again, because the parser does not support merge keys.
        PyCompose.from_yaml(yaml.safe_dump(self.file)).validate()
        self.assertNotIn("${", self.text, "a variable that is neither required nor has a default")
        by_docker = ["docker", "compose", "--file", ROOT / self.FILE]
        by_docker += [part for profile in set(self.PROFILES.values()) for part in ("--profile", profile)]
        if has_docker_compose():
            given = {name: "given" for name in required(read(self.FILE))}
            ran = subprocess.run(
                [*by_docker, "config", "--quiet"], env=given, capture_output=True, text=True, check=False
            )
            self.assertEqual(ran.returncode, 0, ran.stderr)
        report(f"{self.FILE}: {len(self.services)} services, valid according to the Compose specification")

    def test_every_service_is_hardened(self):
        for name, service in self.services.items():
            with self.subTest(name):
                self.assertIs(service.get("read_only"), True)
                self.assertEqual(service.get("cap_drop"), ["ALL"])
                self.assertEqual(service.get("security_opt"), ["no-new-privileges:true"])
                self.assertLessEqual({"cpus", "memory", "pids"}, set(service["deploy"]["resources"]["limits"]))
                self.assertRegex(service["image"], r":v?\d+\.\d+\.\d+(-\w+)?$", "an image without a version")
                for port in service.get("ports", []):
                    self.assertEqual(port["host_ip"], "127.0.0.1", "exposed to the network")
                profile = self.PROFILES.get(name)
                self.assertEqual(service.get("profiles"), [profile] if profile else None)

    def test_its_settings_exist(self):
        check_settings(self, self.FILE)

    def test_its_mounts_exist_and_are_used(self):
        used = set()
        for name, service in self.services.items():
            with self.subTest(name):
                for mount in service.get("volumes", []):
                    if mount["type"] == "bind":
                        self.assertTrue((DEPLOY / mount["source"]).exists(), mount["source"])
                    else:
                        self.assertIn(mount["source"], self.file["volumes"])
                        used.add(mount["source"])
                for secret in service.get("secrets", []):
                    self.assertIn(secret, self.file["secrets"])
        self.assertEqual(used, set(self.file["volumes"]))

    def test_prometheus_and_grafana_find_their_files(self):
        prometheus, grafana = self.services["prometheus"], self.services["grafana"]
        file = next(one.split("=")[1] for one in prometheus["command"] if "config.file" in one)
        folder, name = file.rsplit("/", 1)
        mounts = {mount["target"]: mount["source"] for mount in prometheus["volumes"]}
        self.assertTrue((DEPLOY / mounts[folder] / name).is_file())
        [config] = documents(f"deploy/prometheus/{name}")
        [job] = config["scrape_configs"]
        self.assertEqual(job["authorization"]["credentials_file"], f"/run/secrets/{prometheus['secrets'][0]}")

        mounts = {mount["target"]: mount["source"] for mount in grafana["volumes"]}
        [provider] = documents("deploy/grafana/provisioning/dashboards/whereabouts.yaml")[0]["providers"]
        board = f"{provider['options']['path']}/whereabouts.json"
        self.assertEqual(mounts[board], "./grafana/whereabouts.json")
        self.assertEqual(grafana["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"], board)
        [source] = documents("deploy/grafana/provisioning/datasources/prometheus.yaml")[0]["datasources"]
        self.assertEqual(source["type"], "prometheus")
        self.assertEqual(source["url"], f"http://prometheus:{prometheus['ports'][0]['target']}")
        self.assertEqual(source["jsonData"]["timeInterval"], config["global"]["scrape_interval"])
        password = grafana["environment"]["GF_SECURITY_ADMIN_PASSWORD__FILE"]
        self.assertEqual(password, f"/run/secrets/{grafana['secrets'][0]}")
        report(f"{name} and Grafana's provisioning: keys, mounts and addresses match {self.FILE}")

"""What holds of every Compose file here, and what the image is that they run."""

import re
import subprocess

import yaml
from compose_spec import PyCompose
from files import DEPLOY, ROOT, check_settings, documents, read, told


def instructions():
    """The instructions of the Dockerfile's last stage, by name."""
    text = re.sub(r"\\\n\s*", "", re.sub(r"^#.*\n", "", read("Dockerfile"), flags=re.M))
    lines = re.findall(r"^([A-Z]+) (.*)$", text[text.rindex("\nFROM ") :], flags=re.M)
    return {name: [rest for other, rest in lines if other == name] for name, _ in lines}


def image_environment():
    return dict(re.findall(r"(\w+)=(\S+)", " ".join(instructions()["ENV"])))


def with_variables(text):
    """A Compose file with the default of each variable, and something for those that have to be given."""
    text = re.sub(r"\$\{(\w+):-([^}]*)\}", r"\2", text)
    return re.sub(r"\$\{(\w+):\?[^}]*\}", lambda found: f"given-{found[1].lower()}", text)


def required(text):
    """The variables that have to be given."""
    return set(re.findall(r"\$\{(\w+):\?", text))


def has_docker_compose():
    try:
        ran = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
        return ran.returncode == 0
    except FileNotFoundError:
        return False


class ComposeFile:
    """Tests of `FILE`, whose services have the profiles of `PROFILES`."""

    FILE, PROFILES = None, None

    def setUp(self):
        self.text = with_variables(read(self.FILE))
        self.file = yaml.safe_load(self.text)
        self.services = self.file["services"]

    def test_it_is_what_the_specification_allows(self):
        # Written anew, as its reader does not know merged keys.
        PyCompose.from_yaml(yaml.safe_dump(self.file)).validate()
        self.assertNotIn("${", self.text, "a variable that is neither given nor has a default")
        by_docker = ["docker", "compose", "--file", ROOT / self.FILE]
        by_docker += [part for profile in set(self.PROFILES.values()) for part in ("--profile", profile)]
        if has_docker_compose():
            given = {name: "given" for name in required(read(self.FILE))}
            ran = subprocess.run(
                [*by_docker, "config", "--quiet"], env=given, capture_output=True, text=True, check=False
            )
            self.assertEqual(ran.returncode, 0, ran.stderr)
        told(f"{self.FILE}: {len(self.services)} services, valid by the Compose specification")

    def test_every_service_is_closed(self):
        for name, service in self.services.items():
            with self.subTest(name):
                self.assertIs(service.get("read_only"), True)
                self.assertEqual(service.get("cap_drop"), ["ALL"])
                self.assertEqual(service.get("security_opt"), ["no-new-privileges:true"])
                self.assertLessEqual({"cpus", "memory", "pids"}, set(service["deploy"]["resources"]["limits"]))
                self.assertRegex(service["image"], r":v?\d+\.\d+\.\d+(-\w+)?$", "an image without its version")
                for port in service.get("ports", []):
                    self.assertEqual(port["host_ip"], "127.0.0.1", "open to the network")
                profile = self.PROFILES.get(name)
                self.assertEqual(service.get("profiles"), [profile] if profile else None)

    def test_its_settings_exist(self):
        check_settings(self, self.FILE)

    def test_what_it_mounts_is_there_and_used(self):
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

    def test_prometheus_and_grafana_find_what_they_look_for(self):
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
        told(f"{name} and Grafana's provisioning: keys, mounts and addresses are those of {self.FILE}")

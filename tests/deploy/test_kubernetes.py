"""The manifests: valid by the schemas of Kubernetes, within its profile `restricted`, and of one mind."""

import shutil
import subprocess
import unittest

import kubernetes_validate
import traffic
import yaml
from files import DEPLOY, ROOT, VERSION, check_settings, documents, drain_times, read, settings_in_force, told
from test_containers import image_environment, instructions

FOLDER = DEPLOY / "kubernetes"
# The oldest that has ReadWriteOncePod for everybody, and the newest whose schemas there are.
VERSIONS = ["1.29", "1.37"]


def built():
    """What kustomize makes of the overlay; without it, the files as they are."""
    for tool in (["kubectl", "kustomize"], ["kustomize", "build"]):
        if shutil.which(tool[0]):
            ran = subprocess.run([*tool, FOLDER / "embedded"], capture_output=True, text=True, check=False)
            if ran.returncode:
                raise AssertionError(f"kustomize: {ran.stderr}")
            return list(yaml.safe_load_all(ran.stdout)), " ".join(tool)
    files = [file for file in sorted(FOLDER.glob("*/*.yaml")) if file.name != "kustomization.yaml"]
    return [one for file in files for one in yaml.safe_load_all(file.read_text())], None


def fault(resource, version):
    """Where a resource is not what Kubernetes takes, if so."""
    try:
        kubernetes_validate.validate(resource, version, strict=True)
    except kubernetes_validate.ValidationError as error:
        return f"{resource['kind']}: {'.'.join(map(str, error.path))}: {error.message}"
    return None


class Kubernetes(unittest.TestCase):
    def setUp(self):
        self.resources, self.tool = built()
        self.by_kind = {resource["kind"]: resource for resource in self.resources}
        self.set = self.by_kind["StatefulSet"]
        self.pod = self.set["spec"]["template"]["spec"]
        [self.server] = self.pod["containers"]
        [self.maintenance] = documents("deploy/kubernetes/maintenance.yaml")

    def settings(self):
        [overlay] = documents("deploy/kubernetes/embedded/kustomization.yaml")
        [made] = overlay["configMapGenerator"]
        return made["name"], dict(literal.split("=", 1) for literal in made["literals"])

    def test_every_resource_is_valid(self):
        for resource in [*self.resources, self.maintenance]:
            for version in VERSIONS:
                with self.subTest(resource["kind"], version=version):
                    self.assertIsNone(fault(resource, version))
        how = (
            f"as `{self.tool}` builds them"
            if self.tool
            else "as they are, because there is no kubectl to build them"
        )
        told(
            f"deploy/kubernetes: {len(self.resources) + 1} resources, {how}, valid for {' and '.join(VERSIONS)}"
        )

    def test_every_file_is_part_of_it(self):
        for folder in ("base", "embedded"):
            [listed] = documents(f"deploy/kubernetes/{folder}/kustomization.yaml")
            files = {file.name for file in (FOLDER / folder).glob("*.yaml")} - {"kustomization.yaml"}
            self.assertEqual({name for name in listed["resources"] if name.endswith(".yaml")}, files, folder)

    def test_pods_keep_to_the_profile_restricted(self):
        for pod in (self.pod, self.maintenance["spec"]):
            [container] = pod["containers"]
            of_pod, of_container = pod["securityContext"], container["securityContext"]
            self.assertIs(of_pod["runAsNonRoot"], True)
            self.assertEqual(of_pod["seccompProfile"], {"type": "RuntimeDefault"})
            self.assertIs(of_container["allowPrivilegeEscalation"], False)
            self.assertIs(of_container["readOnlyRootFilesystem"], True)
            self.assertEqual(of_container["capabilities"], {"drop": ["ALL"]})
            self.assertLessEqual({"cpu", "memory"}, set(container["resources"]["limits"]))
            self.assertIs(pod["automountServiceAccountToken"], False)
            # The variables would be WHEREABOUTS_PORT and the like.
            self.assertIs(pod["enableServiceLinks"], False)
            user = f"{of_pod['runAsUser']}:{of_pod['runAsGroup']}"
            self.assertEqual([user], instructions()["USER"])
            self.assertEqual(of_pod["fsGroup"], of_pod["runAsGroup"])
        labels = self.by_kind["Namespace"]["metadata"]["labels"]
        self.assertEqual(labels["pod-security.kubernetes.io/enforce"], "restricted")

    def test_one_process_has_the_volume(self):
        self.assertEqual(self.set["spec"]["replicas"], 1)
        self.assertGreater(self.pod["terminationGracePeriodSeconds"], drain_times())
        claim = self.by_kind["PersistentVolumeClaim"]
        self.assertEqual(claim["spec"]["accessModes"], ["ReadWriteOncePod"])
        for pod in (self.pod, self.maintenance["spec"]):
            claims = [
                volume["persistentVolumeClaim"]["claimName"]
                for volume in pod["volumes"]
                if "persistentVolumeClaim" in volume
            ]
            self.assertEqual(claims, [claim["metadata"]["name"]])

    def test_names_and_ports_agree(self):
        service, policy = self.by_kind["Service"]["spec"], self.by_kind["NetworkPolicy"]["spec"]
        [port] = self.server["ports"]
        self.assertEqual([str(port["containerPort"])], instructions()["EXPOSE"])
        self.assertEqual(service["ports"][0]["targetPort"], port["name"])
        self.assertEqual(service["ports"][0]["appProtocol"], "kubernetes.io/h2c")
        self.assertEqual(policy["ingress"][0]["ports"][0]["port"], port["name"])
        labels = self.set["spec"]["template"]["metadata"]["labels"]
        for selector in (
            service["selector"],
            policy["podSelector"]["matchLabels"],
            self.set["spec"]["selector"]["matchLabels"],
        ):
            self.assertLessEqual(set(selector.items()), set(labels.items()))
        maintenance = self.maintenance["metadata"]["labels"]
        self.assertFalse(
            set(service["selector"].items()) <= set(maintenance.items()), "robots would ask the maintenance pod"
        )
        self.assertEqual(self.set["spec"]["serviceName"], self.by_kind["Service"]["metadata"]["name"])
        self.assertEqual(self.pod["serviceAccountName"], self.by_kind["ServiceAccount"]["metadata"]["name"])
        if self.tool:
            self.assertEqual(self.server["image"], f"whereabouts:{VERSION}")
            [settings] = [source["configMapRef"]["name"] for source in self.server["envFrom"]]
            self.assertEqual(settings, self.by_kind["ConfigMap"]["metadata"]["name"])
            spaces = {
                resource["metadata"].get("namespace")
                for resource in self.resources
                if resource["kind"] != "Namespace"
            }
            self.assertEqual(spaces, {self.by_kind["Namespace"]["metadata"]["name"]})
        [container] = self.maintenance["spec"]["containers"]
        self.assertEqual(container["image"], f"whereabouts:{VERSION}")

    def test_settings_exist_and_stay_in_the_volume(self):
        for file in [*FOLDER.glob("*.yaml"), *FOLDER.glob("*/*.yaml")]:
            check_settings(self, file.relative_to(ROOT))
        name, settings = self.settings()
        self.assertEqual(name, "whereabouts")
        given = {variable["name"]: variable.get("value", "a-secret") for variable in self.server["env"]}
        found = settings_in_force(image_environment() | settings | given)
        mounts = {mount["name"]: mount["mountPath"] for mount in self.server["volumeMounts"]}
        self.assertTrue(found["data"]["dir"].startswith(mounts["data"] + "/"), "not the root of the volume")
        self.assertEqual(found["server"]["listen"].split(":")[1], str(self.server["ports"][0]["containerPort"]))
        told(f"deploy/kubernetes: `whereabouts config` takes its {len(settings) + len(given)} settings")

    def test_probes_ask_what_the_server_answers_without_a_key(self):
        paths = []
        for probe in ("livenessProbe", "readinessProbe"):
            asked = self.server[probe]["httpGet"]
            self.assertEqual(asked["port"], self.server["ports"][0]["name"])
            traffic.expect(traffic.ask("GET", asked["path"], role=None), 200)
            paths.append(asked["path"])
        self.assertEqual(paths, ["/livez", "/readyz"])
        told("deploy/kubernetes: /livez and /readyz answer the probes without a key")

    def test_secrets_are_only_referred_to(self):
        self.assertNotIn("Secret", self.by_kind)
        for variable in self.server["env"]:
            if "KEY" in variable["name"]:
                self.assertIn("secretKeyRef", variable["valueFrom"])
        self.assertNotIn("kind: Secret", read("deploy/kubernetes/maintenance.yaml"))


if __name__ == "__main__":
    unittest.main()

"""The manifests as kustomize builds them, and what holds of every one."""

import shutil
import subprocess

import kubernetes_validate
import yaml
from compose import instructions
from files import DEPLOY, documents, told

FOLDER = DEPLOY / "kubernetes"
# The oldest that has ReadWriteOncePod for everybody, and the newest whose schemas there are.
VERSIONS = ["1.29", "1.37"]


def built(overlay):
    """What kustomize makes of the overlay, and the tool; without one, the files as they are."""
    for tool in (["kubectl", "kustomize"], ["kustomize", "build"]):
        if shutil.which(tool[0]):
            ran = subprocess.run([*tool, FOLDER / overlay], capture_output=True, text=True, check=False)
            if ran.returncode:
                raise AssertionError(f"kustomize: {ran.stderr}")
            return list(yaml.safe_load_all(ran.stdout)), " ".join(tool)
    files = [file for part in ("base", overlay) for file in sorted((FOLDER / part).glob("*.yaml"))]
    files = [file for file in files if file.name != "kustomization.yaml"]
    return [one for file in files for one in yaml.safe_load_all(file.read_text())], None


def settings_of(overlay):
    """The name of the overlay's ConfigMap, and what is in it."""
    [file] = documents(f"deploy/kubernetes/{overlay}/kustomization.yaml")
    [made] = file["configMapGenerator"]
    return made["name"], dict(literal.split("=", 1) for literal in made["literals"])


def check_resources(case, overlay, resources, tool):
    """Fails if one is not what Kubernetes takes, or if a file of the overlay is not part of it."""
    for resource in resources:
        for version in VERSIONS:
            with case.subTest(resource["kind"], version=version):
                case.assertIsNone(fault(resource, version))
    for folder in ("base", overlay):
        [listed] = documents(f"deploy/kubernetes/{folder}/kustomization.yaml")
        files = {file.name for file in (FOLDER / folder).glob("*.yaml")} - {"kustomization.yaml"}
        case.assertEqual({name for name in listed["resources"] if name.endswith(".yaml")}, files, folder)
    how = f"as `{tool}` builds them" if tool else "as they are, because there is no kubectl to build them"
    told(f"kubernetes/{overlay}: {len(resources)} resources, {how}, valid for {' and '.join(VERSIONS)}")


def fault(resource, version):
    """Where a resource is not what Kubernetes takes, if so."""
    try:
        kubernetes_validate.validate(resource, version, strict=True)
    except kubernetes_validate.ValidationError as error:
        return f"{resource['kind']}: {'.'.join(map(str, error.path))}: {error.message}"
    return None


def check_restricted(case, pod):
    """Fails if a pod is not within the profile `restricted`, or may do more than ours need."""
    of_pod = pod["securityContext"]
    case.assertIs(of_pod["runAsNonRoot"], True)
    case.assertEqual(of_pod["seccompProfile"], {"type": "RuntimeDefault"})
    user = f"{of_pod['runAsUser']}:{of_pod['runAsGroup']}"
    case.assertEqual([user], instructions()["USER"])
    case.assertEqual(of_pod["fsGroup"], of_pod["runAsGroup"])
    case.assertIs(pod["automountServiceAccountToken"], False)
    # The variables would be WHEREABOUTS_PORT and the like.
    case.assertIs(pod["enableServiceLinks"], False)
    for container in pod["containers"] + pod.get("initContainers", []):
        of_container = container["securityContext"]
        case.assertIs(of_container["allowPrivilegeEscalation"], False)
        case.assertIs(of_container["readOnlyRootFilesystem"], True)
        case.assertEqual(of_container["capabilities"], {"drop": ["ALL"]})
        case.assertLessEqual({"cpu", "memory"}, set(container["resources"]["limits"]))
        for variable in container.get("env", []):
            if "KEY" in variable["name"] or variable["name"].endswith("DATABASE__URL"):
                case.assertIn("secretKeyRef", variable["valueFrom"], "a secret that is not only referred to")


def check_probes(case, container):
    """Fails if a probe asks for anything but what the server answers without a key."""
    for probe, path in (("livenessProbe", "/livez"), ("readinessProbe", "/readyz")):
        asked = container[probe]["httpGet"]
        case.assertEqual([asked["path"], asked["port"]], [path, container["ports"][0]["name"]])

"""Traffic until every family of metrics has a member, and what it all looks like then."""

import json
import os
import subprocess
import time
import urllib.error
import urllib.request

import exposition
from files import SCRATCH

URL, OUTSIDE = os.environ["URL"], os.environ["OUTSIDE"]
# What takes its time to appear: a message to a webhook is given up, and a search of the index is checked.
LAST = (
    ("whereabouts_webhook_attempts_total", "outcome", "dead"),
    ("whereabouts_neighbours_checked_total", "found", "yes"),
)


def key(role):
    return (SCRATCH / f"{role}.key").read_text().strip()


def ask(method, path, body=None, role="admin", **headers):
    """Status and body of an answer."""
    if role:
        headers["Authorization"] = f"Bearer {key(role)}"
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    request = urllib.request.Request(URL + path, body, headers, method=method)
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def expect(answer, *statuses):
    if answer[0] not in statuses:
        raise AssertionError(f"{answer[0]} instead of {statuses}: {answer[1]}")


def localize(frame, path="/localize?map=town&refine=wait", **headers):
    picture = (SCRATCH / "town/frames" / frame).read_bytes()
    return ask("POST", path, picture, role="robot", Content_Type="image/jpeg", **headers)


def call_grpc():
    """A call of gRPC without a frame, so that its route is there; what it answers does not matter."""
    path = f"{URL}/whereabouts.v1.LocalizationService/Localize"
    (SCRATCH / "empty").write_bytes(bytes(5))
    command = ["curl", "--silent", "--http2-prior-knowledge", "--output", os.devnull, "--data-binary"]
    command += [f"@{SCRATCH}/empty", "--header", "Content-Type: application/grpc", "--header", "TE: trailers"]
    subprocess.run([*command, "--header", f"Authorization: Bearer {key('robot')}", path], check=True)


def make():
    """Makes all that there is to count, and gives the metrics."""
    for path in ("/takes", "/refuses"):
        hook = json.dumps({"url": OUTSIDE + path}).encode()
        expect(ask("POST", "/webhooks", hook, Content_Type="application/json"), 201)
    for frame in ("frame-0000.jpg", "frame-0001.jpg", "frame-0001.jpg"):
        expect(localize(frame), 200)
    expect(localize("frame-0002.jpg", X_Deadline_Ms="1"), 429, 504)
    expect(localize("frame-0002.jpg", path="/localize?map=nowhere"), 404)
    call_grpc()
    for _ in range(150):
        # Searches are checked once there is an index.
        expect(localize("frame-0003.jpg", path="/localize?map=town&refine=off"), 200)
        status, text = ask("GET", "/metrics", role="operator")
        expect((status, text), 200)
        metrics = exposition.parse(text)
        missing = [last for last in LAST if not seen(metrics, *last)]
        if not missing:
            return metrics
        time.sleep(0.2)
    raise AssertionError(f"not there within 30 seconds: {missing}")


def seen(metrics, name, label, value):
    return name in metrics and value in metrics[name].labels[label]

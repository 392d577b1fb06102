"""Generates traffic until every metric family has a sample, and returns the metrics."""

import json
import os
import subprocess
import time
import urllib.error
import urllib.request

import exposition
from files import SCRATCH

URL, OUTSIDE = os.environ["URL"], os.environ["OUTSIDE"]
# The samples that take longest to appear: a dead webhook delivery, and a checked search of the index.
LAST = (
    ("whereabouts_webhook_attempts_total", "outcome", "dead"),
    ("whereabouts_neighbours_checked_total", "found", "yes"),
    # After an image was read.
    ("whereabouts_images_unread", "map", "town"),
)


def key(role):
    return (SCRATCH / f"{role}.key").read_text().strip()


def ask(method, path, body=None, role="admin", **headers):
    """Sends a request; returns the status and the body of the response."""
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
    return localize_bytes((SCRATCH / "town/frames" / frame).read_bytes(), path, **headers)


def localize_bytes(picture, path="/localize?map=town&refine=off", **headers):
    return ask("POST", path, picture, role="robot", Content_Type="image/jpeg", **headers)


def call_grpc():
    """Makes a gRPC call without a frame, so that its route has a sample; the response does not matter."""
    path = f"{URL}/whereabouts.v1.LocalizationService/Localize"
    (SCRATCH / "empty").write_bytes(bytes(5))
    command = ["curl", "--silent", "--http2-prior-knowledge", "--output", os.devnull, "--data-binary"]
    command += [f"@{SCRATCH}/empty", "--header", "Content-Type: application/grpc", "--header", "TE: trailers"]
    subprocess.run([*command, "--header", f"Authorization: Bearer {key('robot')}", path], check=True)


def make():
    """Generates everything that is counted, and returns the metrics."""
    for path in ("/takes", "/refuses"):
        hook = json.dumps({"url": OUTSIDE + path}).encode()
        expect(ask("POST", "/webhooks", hook, Content_Type="application/json"), 201)
    for frame in ("frame-0000.jpg", "frame-0001.jpg", "frame-0001.jpg"):
        expect(localize(frame), 200)
    expect(localize("frame-0002.jpg", X_Deadline_Ms="1"), 429, 504)
    expect(localize("frame-0002.jpg", path="/localize?map=nowhere"), 404)
    # A covered lens, and a picture that lost bytes on the way.
    expect(localize_bytes(b"P5\n64 48\n255\n" + bytes(64 * 48)), 200)
    picture = (SCRATCH / "town/frames/frame-0004.jpg").read_bytes()
    middle = len(picture) // 2
    expect(localize_bytes(picture[:middle] + picture[middle + 2048 :]), 200)
    # The images of the demo are read already.
    unread = (SCRATCH / "town/frames/frame-0000.jpg").read_bytes()
    expect(ask("POST", "/maps/town/images?id=unread", unread, Content_Type="image/jpeg"), 201)
    call_grpc()
    for _ in range(150):
        # Searches are checked only once an index exists.
        expect(localize("frame-0003.jpg", path="/localize?map=town&refine=off"), 200)
        status, text = ask("GET", "/metrics", role="operator")
        expect((status, text), 200)
        metrics = exposition.parse(text)
        missing = [last for last in LAST if not seen(metrics, *last)]
        if not missing:
            return metrics
        time.sleep(0.2)
    raise AssertionError(f"missing after 30 seconds: {missing}")


def seen(metrics, name, label, value):
    return name in metrics and value in metrics[name].labels[label]

"""A real browser for the tests of pages: headless Chromium, spoken to over its debugging pipe."""

import base64
import fcntl
import json
import os
import shutil
import subprocess

import pytest

CHROMIUM = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
HEADLESS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--use-gl=swiftshader", "--enable-unsafe-swiftshader",
    "--remote-debugging-pipe", "--no-first-run", "--disable-extensions", "--hide-scrollbars",
)  # fmt: skip


class Browser:
    """One page. errors: what its console complained about."""

    def __init__(self, folder, width=1280, height=900):
        self.errors = []
        self._count = 0
        theirs, self._out = os.pipe()
        self._in, ours = os.pipe()
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (theirs, ours)]  # clear of 3 and 4
        os.close(theirs), os.close(ours)

        def connect():  # the browser listens on 3 and speaks on 4
            os.dup2(ends[0], 3), os.dup2(ends[1], 4)

        self._process = subprocess.Popen(
            [CHROMIUM, *HEADLESS, f"--user-data-dir={folder}"], preexec_fn=connect,  # noqa: PLW1509  # nothing is threaded here
            pass_fds=(3, 4),
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(ends[0]), os.close(ends[1])
        self._lines = os.fdopen(self._in, "rb")
        self._session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def call(self, method, **parameters):
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._hear()
            if answer.get("id") == self._count:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]

    def open(self, path, seconds=60):
        """Until the page says that it is ready."""
        self.call("Page.navigate", url=path.resolve().as_uri())
        until = f"new Promise(done => {{ const look = () => document.body && document.body.dataset.ready ? done(true) : setTimeout(look, 50); look(); setTimeout(() => done(false), {seconds * 1000}); }})"
        assert self.run(until), self.errors

    def run(self, script):
        """The value of an expression, awaited."""
        found = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    @property
    def empty(self):
        """Ids of figures of which nothing can be seen: no trace, or a drawing context that the browser took back."""
        return self.run("""(() => {
            const lost = canvas => { const gl = canvas.getContext("webgl2") || canvas.getContext("webgl"); return gl && gl.isContextLost(); };
            return [...document.querySelectorAll(".figure")]
                .filter(each => !(each.data || []).length || [...each.querySelectorAll("canvas")].some(lost)).map(each => each.id); })()""")

    def click(self, x, y):
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left" if kind != "mouseMoved" else "none",
                clickCount=1,
            )

    def picture(self, path, whole=True):
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(shot["data"]))

    def close(self):
        self._process.kill()
        self._process.wait()
        os.close(self._out)
        self._lines.close()

    def _hear(self):
        data = bytearray()
        while (byte := self._lines.read(1)) != b"\0":
            assert byte, "the browser is gone"
            data += byte
        message = json.loads(data)
        if message.get("method") == "Runtime.exceptionThrown":
            self.errors.append(message["params"]["exceptionDetails"]["exception"]["description"])
        if message.get("method") == "Log.entryAdded" and message["params"]["entry"]["level"] == "error":
            self.errors.append(message["params"]["entry"]["text"])
        if message.get("method") == "Runtime.consoleAPICalled" and message["params"]["type"] in (
            "error",
            "warning",
        ):
            self.errors.append(str(message["params"]["args"]))
        return message


@pytest.fixture
def browser(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium to open the page with")
    opened = Browser(tmp_path / "profile")
    yield opened
    opened.close()

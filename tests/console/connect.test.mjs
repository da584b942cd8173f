/** Connect: the examples run as they stand, and another program's stream is followed as that program sees it. */

import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { existsSync, mkdtempSync, readFileSync, renameSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import path from "node:path";
import { createInterface } from "node:readline";
import { after, before, describe, it } from "node:test";

import { canvasState, picture, PYTHON, ROOT, seriousFindings, SOURCES, until } from "./harness.mjs";
import { enterPose, IMAGE, openScan, poseOf } from "./scan_page.mjs";
import { tested } from "./tested.mjs";

const ENVIRONMENT = { ...process.env, PYTHONPATH: `${SOURCES}:${path.join(ROOT, "client")}:${path.join(ROOT, "ros")}` };
/** What the ROS 2 node does with the command: its parameters as ROS reads them, and the pose that the example publishes. */
const ROS = `
import json, shlex, sys, yaml
from ultragray_client import Client, Placement, Quaternion
from ultragray_ros.parameters import defaults, settings_of
command, publish = (open(name).read() for name in sys.argv[1:])
words = shlex.split(command.partition("ultragray-ros ")[2].partition("\\n#")[0].replace("\\\\\\n", " "))
assert words[0] == "--ros-args" and set(words[1::2]) == {"-p"}, words
given = {name: yaml.safe_load(value) for name, _, value in (word.partition(":=") for word in words[2::2])}
known = {"address": "", "scene": "", "scene_frame": "scene", **defaults()}
assert {name: type(value) for name, value in given.items()} == {name: type(known[name]) for name in given}, given
publish, _, transform = publish.partition("\\n#")
stamped = yaml.safe_load(shlex.split(publish)[-1])
still = shlex.split(transform.splitlines()[1].removeprefix("# "))
assert [float(still[still.index(f"--{axis}") + 1]) for axis in "xyz"] == [stamped["pose"]["position"][axis] for axis in "xyz"], still
assert f"ultragray.launch.xml address:={given['address']} scene:={given['scene']}" in command, command
assert stamped["header"]["frame_id"] == {**known, **given}["scene_frame"], command
place, turn = stamped["pose"]["position"], stamped["pose"]["orientation"]
pose = Placement(tuple(1000 * place[axis] for axis in "xyz"), Quaternion(**turn))
with Client(given["address"]) as client:
    frame = client.render(given["scene"], pose, settings_of({**known, **given}))
print(json.dumps([*frame["bmode"].shape, frame.display and frame.display.gain_db, frame.probe.kind, [tool.kind for tool in frame.tools]]))
`;
/** The brightest pixel of two pictures, and how far they are apart at most: poses are told to seven digits. */
const APART = `
import sys, cv2, numpy as np
one, other = (cv2.imread(name, cv2.IMREAD_GRAYSCALE).astype(int) for name in sys.argv[1:])
print([int(one.max()), int(np.abs(one - other).max())])
`;
/** What grpcurl does: reads the request as JSON, and calls the method. */
const GRPCURL = `
import shlex, sys, grpc
from google.protobuf import json_format
from ultragray_proto.v1 import rendering_pb2, rendering_pb2_grpc
words = shlex.split(open(sys.argv[1]).read().replace("\\\\\\n", " "))
assert words[0] == "grpcurl" and words[-1] == "ultragray.v1.RenderService/Render", words
request = json_format.Parse(words[words.index("-d") + 1], rendering_pb2.RenderRequest())
with grpc.insecure_channel(words[-2], options=[("grpc.max_receive_message_length", -1)]) as channel:
    frame = rendering_pb2_grpc.RenderServiceStub(channel).Render(request, timeout=60)
print(frame.height, frame.width, len(frame.data), [tool.WhichOneof("kind") for tool in frame.tools])
`;

const at = tested({ environment: { ULTRAGRAY_IGTL_PORT: "0" } });
let folder;
before(() => (folder = mkdtempSync(path.join(tmpdir(), "ultragray-connect-"))));
after(() => rmSync(folder, { recursive: true, force: true }));

async function program(page, language, place = 0) {
  await page.getByLabel("Language of the example").selectOption(language);
  await page.getByRole("button", { name: /^Copy the example in/ }).nth(place).click();
  const text = await page.getByTestId("snippet").nth(place).inputValue();
  assert.equal(await page.evaluate(() => navigator.clipboard.readText()), text);
  return text;
}

function run(command, ...words) {
  return execFileSync(command, words, { cwd: folder, env: ENVIRONMENT, encoding: "utf8", timeout: 120_000 });
}

function written(name, text) {
  const file = path.join(folder, name);
  writeFileSync(file, text);
  return file;
}

/** A program that streams; `say` tells it what to do, `next` waits until the next pose of it is rendered. */
function startRobot(name, settings = { height: 120, width: 100 }) {
  const address = `${at.service.url.replace("http", "ws")}/v1/scenes/demo/stream?name=${name}`;
  const child = spawn(PYTHON, [path.join(ROOT, "tests/console/robot.py"), address, JSON.stringify(settings)], {
    env: ENVIRONMENT,
    stdio: ["pipe", "pipe", "inherit"],
  });
  const lines = createInterface({ input: child.stdout })[Symbol.asyncIterator]();
  return {
    say: (line) => child.stdin.write(`${line}\n`),
    next: () => lines.next(),
    stop: () => child.kill("SIGTERM"),
  };
}

async function follow(page, name) {
  await page.getByText("Open streams").click();
  await page.getByRole("button", { name: `Follow ${name}` }).click();
  await page.getByTestId("following").getByText(`Following ${name}`).waitFor();
}

describe("connect", () => {
  it("gives programs that run as they stand: curl, Python, JavaScript, gRPC, WebSocket, OpenIGTLink, ROS 2", async () => {
    const { page } = await openScan(at);
    await page.getByLabel("Gain", { exact: true }).fill("6");
    await page.getByRole("combobox", { name: "Probe" }).selectOption("convex");
    await until(() => canvasState(page, IMAGE), ({ width }) => width === 640, "no sector came");
    await page.getByLabel("Off the skin").selectOption({ index: 1 });
    await page.getByRole("button", { name: "Add a needle" }).click();
    await page.getByLabel("Frame of the tool").selectOption("probe");
    await page.getByRole("button", { name: "Add a box" }).click();
    run("bash", written("ask.sh", await program(page, "curl")));
    const { width, height } = await canvasState(page, IMAGE);
    const png = readFileSync(path.join(folder, "frame.png"));
    assert.deepEqual([png.readUInt32BE(16), png.readUInt32BE(20)], [width, height]);
    const asking = await program(page, "python");
    assert.match(asking, /tools=\(Needle\(.*frame=ToolFrame\.PROBE\), Box\(/);
    assert.match(run(PYTHON, written("ask.py", asking)), new RegExp(`bmode ${height}x${width}`));
    const fetched = run(process.execPath, written("ask.mjs", await program(page, "javascript")));
    assert.match(fetched, new RegExp(`^${height} ${width} ${height * width} {`));
    const call = written("grpcurl.sh", await program(page, "grpc"));
    assert.equal(run(PYTHON, "-c", GRPCURL, call).trim(), `${height} ${width} ${height * width} ['needle', 'box']`);
    const streamed = run(PYTHON, written("stream.py", await program(page, "websocket"))).trim().split("\n");
    assert.equal(streamed.length, 50);
    assert.match(streamed[49], new RegExp(`^49 \\(1, ${height}, ${width}\\)`));
    assert.match(run(PYTHON, written("igtl.py", await program(page, "igtl"))), /\(1, 256, 256\)/);
    const image = JSON.parse(run(PYTHON, "-c", ROS, written("node.sh", await program(page, "ros")), written("pose.sh", await program(page, "ros", 1))));
    assert.deepEqual(image, [height, width, 6, "convex", ["needle", "box"]]);
    await picture(page, "connect");
    assert.deepEqual(page.faults, []);
  });

  it("gives a program in C# that runs as it stands", { skip: existsSync("/usr/bin/mcs") ? false : "there is no C# compiler (Debian's mono-mcs)" }, async () => {
    const { page } = await openScan(at);
    await page.getByRole("button", { name: "Add a needle" }).click();
    run("mcs", "-r:System.Net.Http.dll", written("Ask.cs", await program(page, "csharp")));
    assert.match(run("mono", "Ask.exe"), /^1,1,256,256 65536 {"distance_mm"/);
  });

  it("gives the programs the poses of a robot where its registration is chosen, and they render the same image", async () => {
    const flange = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 142], [0, 0, 0, 1]];
    const base = [[1, 0, 0, -400], [0, -1, 0, 20], [0, 0, -1, 168], [0, 0, 0, 1]];
    const body = JSON.stringify({ scene: "demo", base_to_scene: base, probe_to_flange: flange });
    const kept = await fetch(`${at.service.url}/v1/registrations/arm`, { method: "PUT", body, headers: { "Content-Type": "application/json" } });
    assert.ok(kept.ok, await kept.text());
    const { page } = await openScan(at);
    for (const name of ["of the probe, in the scene", "arm"]) {
      if (name === "arm") {
        await page.getByRole("button", { name: "Registrations: show or hide" }).click();
        await page.getByRole("radio", { name }).check();
        await page.getByText("The pose is flange to base; the service leads it into the scene by arm.").waitFor();
      }
      const asking = await program(page, "curl");
      assert.equal(asking.includes('"registration": "arm"'), name === "arm");
      run("bash", written("ask.sh", asking));
      renameSync(path.join(folder, "frame.png"), path.join(folder, name === "arm" ? "arm.png" : "probe.png"));
    }
    const [most, apart] = JSON.parse(run(PYTHON, "-c", APART, "probe.png", "arm.png"));
    assert.ok(most > 100 && apart <= 2, `the robot's pose shows another image: ${apart} grey values apart`);
    const asking = await program(page, "python");
    assert.match(asking, /registration="arm"/);
    assert.match(run(PYTHON, written("ask.py", asking)), /bmode \d+x\d+/);
    const call = written("grpcurl.sh", await program(page, "grpc"));
    assert.match(run(PYTHON, "-c", GRPCURL, call), /^\d+ \d+ \d+ \[\]/);
    const [node, pose] = [await program(page, "ros"), await program(page, "ros", 1)];
    assert.match(pose, /frame_id: base/);
    assert.equal(JSON.parse(run(PYTHON, "-c", ROS, written("node.sh", node), written("pose.sh", pose)))[3], "linear");
    await program(page, "igtl");
    await page.getByText("names a registration by the parameter Registration").waitFor();
    assert.deepEqual(page.faults, []);
  });

  it("follows another program: its frames, its pose, its probe, until the person moves", async () => {
    const robot = startRobot("UR5", { height: 120, width: 100, probe: { kind: "linear", width_mm: 30, near_mm: 0, far_mm: 40 } });
    try {
      await robot.next();
      const { page } = await openScan(at, { width: 1920, height: 1080 });
      await follow(page, "UR5");
      robot.say("x 3");
      await robot.next();
      await until(() => canvasState(page, IMAGE), (state) => state.width === 100 && state.height === 120, "its frames do not come");
      for (const x of [1, 2, 4]) {
        robot.say(`x ${x}`);
        await robot.next();
        await until(() => poseOf(page), ({ position_mm }) => position_mm.x === x, "its pose does not come");
      }
      await page.getByLabel("Latency on the image").check();
      await page.getByTestId("latency").getByText("rendered in").waitFor();
      await picture(page, "connect-following");
      await page.locator(`${IMAGE} .steer`).focus();
      await page.keyboard.press("ArrowRight");
      await page.getByTestId("unfollowed").getByText("You moved the probe: no longer following UR5.").waitFor();
      robot.say("x 9");
      await robot.next();
      await page.waitForTimeout(400);
      assert.ok((await poseOf(page)).position_mm.x < 9, "it still follows");
      await page.getByTestId("latency").getByText(/latency \d+ ms/).waitFor();
      assert.deepEqual([page.faults, page.foreign], [[], []]);
    } finally {
      robot.stop();
    }
  });

  it("renders by itself what no page can show, and tells when the program has gone", async () => {
    const robot = startRobot("planner", { height: 90, width: 80, encoding: "float32", outputs: ["coverage"] });
    try {
      await robot.next();
      const { page } = await openScan(at);
      await follow(page, "planner");
      robot.say("x 2");
      await page.getByTestId("following").getByText("the same poses are rendered here").waitFor();
      await until(() => canvasState(page, IMAGE), (state) => state.width === 80 && state.height === 90 && state.mean > 1, "nothing is rendered");
      robot.stop();
      await page.getByTestId("unfollowed").getByText("planner has closed its stream.").waitFor();
      await until(() => canvasState(page, IMAGE), ({ width }) => width === 256, "the page's own image did not come back");
    } finally {
      robot.stop();
    }
  });

  it("does not list the page's own stream, and knows other pages of the console", async () => {
    const { page } = await openScan(at);
    await page.getByText("Open streams").click();
    await page.getByText("No other program has a stream open on this scene.").waitFor();
    const { page: other } = await openScan(at);
    await page.getByRole("button", { name: "Follow Another page of the console" }).click();
    await enterPose(other, '{"position_mm": {"x": 5, "y": 1, "z": 0}, "quaternion": {"w": 1, "x": 0, "y": 0, "z": 0}}');
    await until(() => poseOf(page), ({ position_mm }) => position_mm.x === 5 && position_mm.y === 1, "it does not follow");
    assert.deepEqual(await seriousFindings(page), []);
  });

  it("tells version, renderer and documentation, and latency on the image only when asked", async () => {
    const { page } = await openScan(at);
    await until(() => page.getByTestId("service-version").textContent(), (text) => /^\d+\.\d+/.test(text), "no version");
    await until(() => page.getByTestId("service-renderer").textContent(), (text) => /^ultragray\/.* cpu/.test(text), "no renderer");
    assert.equal(await page.getByRole("link", { name: "API documentation" }).getAttribute("href"), "/docs");
    assert.equal(await page.getByTestId("latency").count(), 0);
    await page.getByLabel("Latency on the image").check();
    await page.getByTestId("latency").getByText(/latency \d+ ms, 99 % below \d+ ms/).waitFor();
    await page.getByTestId("latency").getByText(/age of the image/).waitFor();
  });
});

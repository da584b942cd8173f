/** The frame of now as programs in other languages ask for it: whole programs, which run as they stand. */

import { differingFields, type StreamSettings, type Tool } from "../api/contract";
import type { ServiceInfo } from "../api/service";
import { entry, type Pose, position, quaternion } from "../geometry/pose";

function keywords(values: Given): string {
  return Object.entries(values).map(([name, value]) => `${name}=${literal(value)}`).join(", ");
}

/** A value as Python writes it. */
function literal(value: unknown): string {
  if (value === null) return "None";
  if (typeof value === "boolean") return value ? "True" : "False";
  if (Array.isArray(value)) return `[${value.map(literal).join(", ")}]`;
  if (typeof value === "object")
    return `{${Object.entries(value as Given).map(([name, one]) => `${JSON.stringify(name)}: ${literal(one)}`).join(", ")}}`;
  return JSON.stringify(value);
}

function capital(word: string): string {
  return word.charAt(0).toUpperCase() + word.slice(1);
}

/** Where the service is, and what it says of its doors. */
export interface Target extends ServiceInfo {
  /** As the page found it: https://host:port */
  origin: string;
  host: string;
  scene: string;
}

/** What is asked for. */
export interface Asked {
  /** Probe to scene; flange to base where the settings name a registration. */
  pose: Pose;
  /** Of the probe that the scene was trained with, which OpenIGTLink takes. */
  trainedPose: Pose;
  settings: StreamSettings;
}

type Given = Record<string, unknown>;
/** A tool without what is as usual. */
type ToldTool = Given & Pick<Tool, "kind">;

const KEY = "YOUR_KEY";
const MOST_DEVICE_NAME = 20; // letters, in OpenIGTLink
const LARGEST_MESSAGE = 64 * 2 ** 20;
const GRPC_ENUMS = { below_min_confidence: "BELOW_CONFIDENCE", contact: "CONTACT", speckle: "SPECKLE" };
const WHOLE_PARAMETERS = ["height", "width", "display.display_seed"]; // of the ROS 2 node

const PROGRAMS = { curl, python, javascript, csharp, grpc, websocket, igtl, ros };
export type Language = keyof typeof PROGRAMS;
export const LANGUAGES = Object.keys(PROGRAMS) as Language[];

/** The program, or those that run beside each other; null where the service has no such door. */
export function snippets(language: Language, target: Target, asked: Asked): string[] | null {
  const found = PROGRAMS[language](target, asked);
  return found === null ? null : [found].flat();
}

function curl(target: Target, asked: Asked): string {
  const key = target.key_required ? ` -H 'X-API-Key: ${KEY}'` : "";
  return `curl -sS --fail-with-body ${renderAddress(target)}${key} \\
  -H 'Content-Type: application/json' -H 'Accept: image/png' -o frame.png \\
  -d '${body(asked, "  ")}'
`;
}

/** The JSON that asks for the frame, a line a member, its last line indented. */
function body({ pose, settings }: Asked, indent: string): string {
  const parts = Object.entries({ pose: placement(pose), ...known(settings) });
  return `{\n${parts.map(([name, value]) => `${indent}  ${JSON.stringify(name)}: ${JSON.stringify(value)}`).join(",\n")}\n${indent}}`;
}

function renderAddress({ origin, scene }: Target): string {
  return `${origin}/v1/scenes/${encodeURIComponent(scene)}/render`;
}

function javascript(target: Target, asked: Asked): string {
  const key = target.key_required ? `\n    "X-API-Key": "${KEY}",` : "";
  return `const answer = await fetch("${renderAddress(target)}", {
  method: "POST",
  headers: {${key}
    "Content-Type": "application/json",
    Accept: "application/octet-stream",
  },
  body: JSON.stringify(${body(asked, "  ")}),
});
if (!answer.ok) throw new Error((await answer.json()).detail);
const [, , height, width] = answer.headers.get("X-Ultragray-Shape").split(",").map(Number);
const pixels = new Uint8Array(await answer.arrayBuffer()); // row by row
console.log(height, width, pixels.length, JSON.parse(answer.headers.get("X-Ultragray-Extrapolation")));
`;
}

function csharp(target: Target, asked: Asked): string {
  const key = target.key_required ? `\n            request.Headers.Add("X-API-Key", "${KEY}");` : "";
  return `// Live, as a stream, and in Unity: by the client in engines/csharp.
using System;
using System.Linq;
using System.Net.Http;
using System.Text;
using System.Threading.Tasks;

public static class Example
{
    public static void Main()
    {
        Ask().GetAwaiter().GetResult();
    }

    static async Task Ask()
    {
        var body = @"${body(asked, "        ").replaceAll('"', '""')}";
        using (var http = new HttpClient())
        using (var request = new HttpRequestMessage(HttpMethod.Post, "${renderAddress(target)}"))
        {
            request.Headers.Add("Accept", "application/octet-stream");${key}
            request.Content = new StringContent(body, Encoding.UTF8, "application/json");
            using (var answer = await http.SendAsync(request))
            {
                var pixels = await answer.Content.ReadAsByteArrayAsync(); // row by row
                if (!answer.IsSuccessStatusCode) throw new Exception(Encoding.UTF8.GetString(pixels));
                var shape = answer.Headers.GetValues("X-Ultragray-Shape").First(); // outputs, poses, height, width
                Console.WriteLine(shape + " " + pixels.Length + " " + answer.Headers.GetValues("X-Ultragray-Extrapolation").First());
            }
        }
    }
}
`;
}

function python(target: Target, { pose, settings }: Asked): string {
  const { probe, display, tools, ...plain } = known(settings) as Given & { probe?: Given; display?: Given; tools?: ToldTool[] };
  const parts = Object.entries(plain).map(([name, value]) => `${name}=${literal(value)}`);
  const classes = ["Client", "RenderSettings"];
  if (display !== undefined) {
    classes.push("Display");
    parts.push(`display=Display(${keywords(display)})`);
  }
  if (probe !== undefined) {
    const { kind, ...numbers } = probe;
    const name = `${capital(String(kind))}Probe`;
    classes.push(name);
    parts.push(`probe=${name}(${keywords(numbers)})`);
  }
  if (tools !== undefined) {
    parts.push(`tools=(${tools.map((tool) => `${pythonTool(tool)},`).join(" ")})`);
    classes.push(...new Set(tools.map(({ kind }) => capital(kind))));
    if (tools.some(({ frame }) => frame !== undefined)) classes.push("ToolFrame");
  }
  const options = [isSecure(target) ? ", tls=Tls()" : "", target.key_required ? `, api_key="${KEY}"` : ""].join("");
  if (isSecure(target)) classes.push("Tls");
  return `import numpy as np
from ultragray_client import ${classes.sort().join(", ")}

pose = ${matrix(pose)}
settings = RenderSettings(${parts.join(", ")})
with Client("${target.host}:${target.grpc_port}"${options}) as client:
    frame = client.render("${target.scene}", pose, settings)
print(frame, frame.extrapolation)
np.save("frame.npy", frame["bmode"])
`;
}

function grpc(target: Target, { pose, settings }: Asked): string {
  const { probe, outputs, tools, ...plain } = known(settings) as Given & {
    probe?: Given;
    outputs?: string[];
    tools?: ToldTool[];
  };
  const message: Given = { scene: target.scene, ...plain };
  if (outputs !== undefined) message.outputs = outputs.map((output) => `OUTPUT_${output.toUpperCase()}`);
  for (const [name, prefix] of Object.entries(GRPC_ENUMS))
    if (message[name] !== undefined) message[name] = `${prefix}_${String(message[name]).toUpperCase()}`;
  if (probe !== undefined) {
    const { kind, ...numbers } = probe;
    message.probe = { [String(kind)]: numbers };
  }
  if (tools !== undefined) message.tools = tools.map(grpcTool);
  const request = JSON.stringify({ settings: message, pose: { matrix: { values: pose.map(short) } } });
  const key = target.key_required ? ` -H 'x-api-key: ${KEY}'` : "";
  return `grpcurl${isSecure(target) ? "" : " -plaintext"} -max-msg-sz ${LARGEST_MESSAGE}${key} \\
  -d '${request}' \\
  ${target.host}:${target.grpc_port} ultragray.v1.RenderService/Render
`;
}

function websocket(target: Target, { pose, settings }: Asked): string {
  return `import json
import struct

import numpy as np
from websockets.sync.client import connect

pose = ${literal(placement(pose))}
settings = ${literal(known(settings))}
with connect(${streamAddress(target, "example")}) as stream:
    for step in range(50):
        pose["position_mm"]["y"] += 0.1  # read your tracker here
        message = {"sequence": step, "mode": "latest", "pose": pose}
        if step == 0:
            message["settings"] = settings
        stream.send(json.dumps(message))
        answer = stream.recv()
        if isinstance(answer, str):
            print(json.loads(answer)["error"]["detail"])
            continue
        (length,) = struct.unpack_from("<I", answer)
        header = json.loads(answer[4 : 4 + length])
        pixels = np.frombuffer(answer, np.uint8, offset=4 + length).reshape(-1, header["height"], header["width"])
        print(header["sequence"], pixels.shape, header["extrapolation"])
`;
}

function igtl({ scene, host, igtl_is_local, igtl_port }: Target, { trainedPose }: Asked): string | null {
  if (igtl_port === null) return null;
  const device = scene.length > MOST_DEVICE_NAME ? "ProbeToReference" : scene;
  const image = scene.length > MOST_DEVICE_NAME ? "Image_Reference" : `Image_${scene}`.slice(0, MOST_DEVICE_NAME);
  return `import numpy as np
import pyigtl

pose = ${matrix(trainedPose)}
client = pyigtl.OpenIGTLinkClient("${igtl_is_local ? "127.0.0.1" : host}", ${igtl_port})
client.send_message(pyigtl.TransformMessage(pose, device_name="${device}"))
image = client.wait_for_message("${image}", timeout=30)
print(image.image.shape, image.ijk_to_world_matrix)
client.stop()
`;
}

/** The command of the node, and beside it the pose of now for it. */
function ros(target: Target, { pose, settings }: Asked): string[] {
  const [x, y, z] = position(pose).map((value) => short(value / 1000));
  const [w, i, j, k] = quaternion(pose).map(short);
  const place = `position: {x: ${x}, y: ${y}, z: ${z}}, orientation: {x: ${i}, y: ${j}, z: ${k}, w: ${w}}`;
  const { display, probe, tools, encoding: _, ...plain } = known(settings) as Given & { display?: Given; probe?: Given; tools?: ToldTool[] };
  const given: Given = { address: `${target.host}:${target.grpc_port}`, scene: target.scene, ...plain };
  const frame = settings.registration == null ? "scene" : "base";
  if (frame !== "scene") given.scene_frame = frame;
  if (isSecure(target)) given.tls = true;
  if (probe !== undefined) given.probe = JSON.stringify(probe);
  if (tools !== undefined) given.tools = JSON.stringify(tools);
  for (const [name, value] of Object.entries(display ?? {})) given[`display.${name}`] = value;
  const parameters = Object.entries(given)
    .map(([name, value]) => ` \\\n  -p '${name}:=${parameter(name, value).replaceAll("'", "'\\''")}'`);
  const key = target.key_required ? `ULTRAGRAY_API_KEY=${KEY} ` : "";
  const node = `${key}ultragray-ros --ros-args${parameters.join("")}
# As a launch file, with settings as the scene has them:
# ${key}ros2 launch ultragray_ros ultragray.launch.xml address:=${String(given.address)} scene:=${target.scene} scene_frame:=${frame}
`;
  const topic = `ros2 topic pub --once /ultragray/probe_pose geometry_msgs/msg/PoseStamped '{header: {frame_id: ${frame}}, pose: {${place}}}'
# As a transform, for a node with -p source:=tf:
# ros2 run tf2_ros static_transform_publisher --x ${x} --y ${y} --z ${z} --qx ${i} --qy ${j} --qz ${k} --qw ${w} --frame-id ${frame} --child-frame-id probe
`;
  return [node, topic];
}

/** A value of a parameter as YAML, of which JSON is a part; ROS tells numbers with decimals from whole ones. */
function parameter(name: string, value: unknown): string {
  if (Array.isArray(value)) return `[${value.map((one) => parameter(name, one)).join(", ")}]`;
  const isWhole = WHOLE_PARAMETERS.includes(name);
  return typeof value === "number" && Number.isInteger(value) && !isWhole ? value.toFixed(1) : JSON.stringify(value);
}

function streamAddress(target: Target, name: string): string {
  const base = target.origin.replace(/^http/, "ws");
  const address = `"${base}/v1/scenes/${encodeURIComponent(target.scene)}/stream?name=${name}"`;
  return `${address}, max_size=None${target.key_required ? `, additional_headers={"X-API-Key": "${KEY}"}` : ""}`;
}

function isSecure({ origin }: Target): boolean {
  return origin.startsWith("https:");
}

/** Settings without those that are left to the scene. */
function known(settings: StreamSettings): Given {
  const { display, tools, ...others } = settings as Given & { display?: Given | null; tools?: Tool[] | null };
  const given = Object.fromEntries(Object.entries(others).filter(([, value]) => value !== null));
  if (given.min_confidence === undefined) delete given.below_min_confidence;
  if (tools) given.tools = tools.map(differingFields);
  const shown = Object.entries(display ?? {}).filter(([, value]) => value !== null && !(Array.isArray(value) && value.length === 0));
  return shown.length > 0 ? { ...given, display: Object.fromEntries(shown) } : given;
}

function pythonTool({ kind, frame, ...numbers }: ToldTool): string {
  const parts = [keywords(numbers), ...(frame === undefined ? [] : [`frame=ToolFrame.${String(frame).toUpperCase()}`])];
  return `${capital(kind)}(${parts.join(", ")})`;
}

/** Points and rotations have named parts in the messages of gRPC. */
function grpcTool({ kind, frame, ...numbers }: ToldTool): Given {
  const named = ([name, value]: [string, unknown]): [string, unknown] => {
    if (!Array.isArray(value)) return [name, value];
    const parts = value.length === 4 ? "wxyz" : "xyz";
    return [name, Object.fromEntries(value.map((one, index) => [parts[index], one as unknown]))];
  };
  const message = Object.fromEntries(Object.entries(numbers).map(named));
  if (frame !== undefined) message.frame = `TOOL_FRAME_${String(frame).toUpperCase()}`;
  return { [kind]: message };
}

function placement(pose: Pose): Given {
  const [x, y, z] = position(pose).map(short);
  const [w, i, j, k] = quaternion(pose).map(short);
  return { position_mm: { x, y, z }, quaternion: { w, x: i, y: j, z: k } };
}

function matrix(pose: Pose): string {
  const rows = [0, 1, 2, 3].map((row) => `[${[0, 1, 2, 3].map((column) => short(entry(pose, row, column))).join(", ")}]`);
  return `np.array([${rows.join(", ")}], dtype=float)`;
}

/** Seven digits are enough for a rotation to be taken as one, and for nanometres. */
function short(value: number): number {
  return Number(value.toFixed(7)) + 0;
}

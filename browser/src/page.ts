/** The page that `ultragray export scene.ugr --page` writes: a scene, its sweep to move along, and the image. */

import type { Frame, Pose, Settings, UltragrayProbe } from "./index.js";
import "./index.js";

/** page.json. */
interface Page {
  title: string;
  poses: Pose[];
  settings: Settings;
  labels: boolean;
}

const find = <Kind extends Element>(selector: string): Kind => document.querySelector<Kind>(selector)!;
const probe = find<UltragrayProbe>("ultragray-probe");
const sweep = find<HTMLInputElement>("#sweep");
const gain = find<HTMLInputElement>("#gain");
const output = find<HTMLSelectElement>("#output");
const status = find<HTMLOutputElement>("#status");

const page = (await (await fetch("page.json")).json()) as Page;
document.title = find("h1").textContent = page.title;
sweep.max = String(page.poses.length - 1);
sweep.value = String(Math.floor(page.poses.length / 2));
if (!page.labels) find('option[value="labels"]').remove();

function take(): void {
  const display = { ...page.settings.display, gain_db: Number(gain.value) };
  probe.settings = { ...page.settings, outputs: [output.value], display } as Settings;
}

sweep.addEventListener("input", () => (probe.pose = page.poses[Number(sweep.value)]!));
gain.addEventListener("input", take);
output.addEventListener("input", take);
probe.addEventListener("frame", (event) => {
  const { frame, pose } = (event as CustomEvent<{ frame: Frame; pose: Pose }>).detail;
  const [x, y, z] = [pose[3]!, pose[7]!, pose[11]!].map((mm) => mm.toFixed(1));
  const { confidence } = frame.extrapolation;
  const trust = confidence === null ? "" : ` · expected similarity ${(100 * confidence).toFixed(0)} %`;
  status.value = `x ${x}, y ${y}, z ${z} mm · ${frame.info.width}×${frame.info.height} pixels${trust}`;
});
probe.addEventListener("problem", (event) => (status.value = (event as CustomEvent<Error>).detail.message));
take();
probe.pose = page.poses[Number(sweep.value)]!;
probe.setAttribute("src", "scene.ugz");

/** `<ultragray-probe src="scene.ugr" pose="…">`: a live image that is steered by pointer, keys and gamepad.
 *
 * Attributes: `src`, the address of a scene file that is rendered here, or `service` and `scene` of one that a service
 * renders; `pose`, 16 numbers; `settings`, JSON; `renderer`, what draws here (auto, wasm, webgpu). Properties:
 * `pose`, numbers, and `settings`, an object.
 * Events: `frame` (detail: the Frame and its pose), `progress` (detail: the share of the file that frames show, while a
 * compressed one arrives), `problem` (detail: an Error).
 */

import { IDENTITY, type Pose } from "./pose.js";
import { Scene, type Frame, type Settings } from "./scene.js";
import { moved, type Motion } from "./steering.js";
import type { RendererChoice } from "./worker.js";

const STEP_MM = 0.5;
const STEP_DEG = 1;
const DRAG = 0.1; // mm for each pixel of the page
const KEYS: Record<string, Motion> = {
  ArrowLeft: { x: -STEP_MM },
  ArrowRight: { x: STEP_MM },
  ArrowUp: { y: STEP_MM },
  ArrowDown: { y: -STEP_MM },
  w: { z: STEP_MM },
  s: { z: -STEP_MM },
  a: { rotate: -STEP_DEG },
  d: { rotate: STEP_DEG },
  q: { rock: -STEP_DEG },
  e: { rock: STEP_DEG },
  r: { tilt: STEP_DEG },
  f: { tilt: -STEP_DEG },
};
const DEAD_ZONE = 0.15; // of a stick
const STYLE = `
  :host { background: #000; container-type: size; display: grid; height: 24rem; place-items: center; touch-action: none; }
  :host(:focus-visible) { outline: 2px solid #4c9ffe; outline-offset: 2px; }
  canvas { aspect-ratio: var(--ratio, 1); display: block; width: min(100cqw, 100cqh * var(--ratio, 1)); }
`;

export class UltragrayProbe extends HTMLElement {
  static readonly observedAttributes = ["src", "service", "scene", "renderer", "pose", "settings"];

  #canvas = document.createElement("canvas");
  #scene: Promise<Scene> | undefined;
  #pose: Pose = IDENTITY;
  #settings: Settings = {};
  #wanted = false;
  #drawing = false;
  #gamepad = 0;
  #held: readonly [number, number] = [0, 0]; // where the pointer was

  constructor() {
    super();
    const shadow = this.attachShadow({ mode: "open" });
    const style = new CSSStyleSheet(); // which a page's content security policy lets pass
    style.replaceSync(STYLE);
    shadow.adoptedStyleSheets = [style];
    shadow.append(this.#canvas);
    this.addEventListener("keydown", (event) => this.#key(event));
    this.addEventListener("pointerdown", (event) => this.#take(event));
    this.addEventListener("pointermove", (event) => this.#drag(event));
    this.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
  }

  get pose(): Pose {
    return this.#pose;
  }

  set pose(pose: Pose) {
    this.#pose = pose;
    this.#draw();
  }

  get settings(): Settings {
    return this.#settings;
  }

  set settings(settings: Settings) {
    this.#settings = settings;
    this.#draw();
  }

  move(motion: Motion): void {
    this.pose = moved(this.#pose, motion);
  }

  connectedCallback(): void {
    this.tabIndex = 0;
    this.setAttribute("role", "application");
    if (!this.hasAttribute("aria-label"))
      this.setAttribute("aria-label", "Ultrasound image. Arrow keys move the probe, W and S push it, A and D turn it, Q, E, R and F tilt it.");
    this.#gamepad = requestAnimationFrame(() => this.#stick());
    this.#open();
  }

  disconnectedCallback(): void {
    cancelAnimationFrame(this.#gamepad);
    this.#close();
  }

  attributeChangedCallback(name: string, _: string | null, value: string | null): void {
    if (name === "pose") this.#pose = (value ?? "").split(/[\s,]+/).filter(Boolean).map(Number);
    if (name === "settings") this.#settings = JSON.parse(value || "{}") as Settings;
    if (!this.isConnected) return;
    if (name === "pose" || name === "settings") this.#draw();
    else this.#open();
  }

  #close(): void {
    void this.#scene?.then((scene) => scene.close()).catch(() => undefined);
    this.#scene = undefined;
  }

  #open(): void {
    this.#close();
    const [src, service, name] = ["src", "service", "scene"].map((attribute) => this.getAttribute(attribute));
    if (src) this.#scene = this.#load(new URL(src, document.baseURI));
    else if (service && name) this.#scene = Scene.connect(service, name);
    else return;
    this.#draw();
  }

  /** A scene whose image is drawn anew with all that arrives. */
  async #load(address: URL): Promise<Scene> {
    const progress = (share: number): void => {
      this.#draw();
      this.dispatchEvent(new CustomEvent("progress", { detail: share }));
    };
    const renderer = (this.getAttribute("renderer") ?? "auto") as RendererChoice;
    const scene = await Scene.load(address, { progress, renderer });
    scene.whole.catch((error: Error) => this.dispatchEvent(new CustomEvent("problem", { detail: error })));
    return scene;
  }

  /** Draws the newest pose, and after it none that was overtaken. */
  #draw(): void {
    this.#wanted = true;
    if (!this.#drawing && this.#scene !== undefined) void this.#drawAll(this.#scene);
  }

  async #drawAll(opened: Promise<Scene>): Promise<void> {
    this.#drawing = true;
    try {
      const scene = await opened;
      while (this.#wanted && this.#scene === opened) {
        this.#wanted = false;
        const pose = this.#pose;
        this.#show(await scene.render(pose, this.#settings), pose);
      }
    } catch (error) {
      this.dispatchEvent(new CustomEvent("problem", { detail: error }));
    } finally {
      this.#drawing = false;
    }
    if (this.#wanted && this.#scene !== undefined && this.#scene !== opened) void this.#drawAll(this.#scene);
  }

  #show(frame: Frame, pose: Pose): void {
    const { height, width, picture } = frame.info;
    this.#canvas.height = height;
    this.#canvas.width = width;
    const [across, down] = picture.column_unit === "mm" ? picture.step.map(Math.abs) : [1, 1]; // true to scale
    this.#canvas.style.setProperty("--ratio", String((width * across!) / (height * down!)));
    this.#canvas.getContext("2d")!.putImageData(frame.imageData(), 0, 0);
    this.dispatchEvent(new CustomEvent("frame", { detail: { frame, pose } }));
  }

  #key(event: KeyboardEvent): void {
    const motion = KEYS[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (motion === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    this.move(motion);
  }

  #take({ pointerId, isPrimary, clientX, clientY }: PointerEvent): void {
    this.setPointerCapture(pointerId);
    if (isPrimary) this.#held = [clientX, clientY];
  }

  #drag({ buttons, isPrimary, shiftKey, clientX, clientY }: PointerEvent): void {
    if (buttons === 0 || !isPrimary) return;
    const [across, down] = [DRAG * (clientX - this.#held[0]), DRAG * (clientY - this.#held[1])]; // fingers have no movementX everywhere
    this.#held = [clientX, clientY];
    if (shiftKey || buttons === 2) this.move({ rock: across, tilt: down });
    else this.move({ x: across, y: -down });
  }

  #wheel(event: WheelEvent): void {
    event.preventDefault();
    this.move({ rotate: Math.sign(event.deltaY) * STEP_DEG });
  }

  /** A gamepad's sticks move and tilt, while the page is looked at. */
  #stick(): void {
    const stick = (navigator.getGamepads?.() ?? []).find((pad) => pad !== null)?.axes ?? [];
    const [x, y, rock, tilt] = [0, 1, 2, 3].map((axis) => (Math.abs(stick[axis] ?? 0) > DEAD_ZONE ? stick[axis]! : 0)) as [number, number, number, number];
    if (x || y || rock || tilt) this.move({ x: x * STEP_MM, y: -y * STEP_MM, rock: rock * STEP_DEG, tilt: tilt * STEP_DEG });
    this.#gamepad = requestAnimationFrame(() => this.#stick());
  }
}

customElements.define("ultragray-probe", UltragrayProbe);

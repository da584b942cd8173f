/** Planes of a scene's frames by WebGPU: the plan of the CUDA backend in WGSL (docs/physics.md §8). */

import { common, draw, finish, slice } from "../generated/shaders.js";
import { wantedPlanes, type Gaussians, type Library, type Plan } from "../library.js";

const BLOCK = 128; // as in common.wgsl, and so are the tile and the bytes
const TILE = 16;
const VIEW_BYTES = 128;
const SLICE_BYTES = 40;
const EXTENT_BYTES = 28;
const BOUNDS_BYTES = 20;
const FINISH_COLUMNS = 64;
const MOST_WAIT_MS = 3000; // for word of the GPU
const FAR = 1e30; // in place of what is infinite: WGSL need not know that

/** The passes of frames of one view, and what they draw into. */
interface Drawing {
  view: GPUBuffer;
  planes: GPUBuffer;
  own: GPUBuffer[];
  passes: { pipeline: GPUComputePipeline; bindings: GPUBindGroup; groups: [number, number] }[];
  unused: GPUBuffer[]; // that planes were read from before
}

export class GpuRenderer {
  #drawings = new Map<number, Promise<Drawing>>();
  #scene: GPUBuffer[] = [];
  #blocks: number;
  #pipelines = new Map<string, Promise<GPUComputePipeline[]>>();
  isLost = false;

  private constructor(
    private readonly device: GPUDevice,
    private readonly scene: Gaussians,
  ) {
    void device.lost.then(() => (this.isLost = true));
    this.#blocks = Math.ceil(scene.count / BLOCK);
  }

  /** Of a scene that the library holds. Throws, in a sentence, where no adapter suffices; one in software does only if asked. */
  static async open(library: Library, scene: number, { software }: { software: boolean }): Promise<GpuRenderer> {
    const adapter = await answered(navigator.gpu?.requestAdapter({ powerPreference: "high-performance" }));
    if (!adapter) throw new Error("there is no WebGPU adapter");
    if (adapter.info.isFallbackAdapter && !software) throw new Error("the WebGPU adapter is software, which is slower than WebAssembly");
    const { maxStorageBufferBindingSize, maxBufferSize } = adapter.limits;
    const device = await adapter.requestDevice({ requiredLimits: { maxStorageBufferBindingSize, maxBufferSize } });
    const renderer = new GpuRenderer(device, library.gaussians(scene));
    try {
      await renderer.#checked(() => renderer.#upload());
    } catch (error) {
      device.destroy();
      throw error;
    }
    return renderer;
  }

  /** What `take` makes of the planes that a plan wants, [H, W] one after another, which are there only meanwhile. */
  async render<Result>(view: number, plan: Plan, take: (planes: Float32Array<ArrayBuffer>) => Result): Promise<Result> {
    const drawing = await kept(this.#drawings, view, () => this.#draws(plan));
    const { size } = drawing.planes;
    const read = drawing.unused.pop() ?? this.device.createBuffer({ size, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST });
    this.device.queue.writeBuffer(drawing.view, 0, this.#view(plan));
    const encoder = this.device.createCommandEncoder();
    const pass = encoder.beginComputePass();
    for (const { pipeline, bindings, groups } of drawing.passes) {
      pass.setPipeline(pipeline);
      pass.setBindGroup(0, bindings);
      pass.dispatchWorkgroups(...groups);
    }
    pass.end();
    encoder.copyBufferToBuffer(drawing.planes, 0, read, 0, size);
    this.device.queue.submit([encoder.finish()]);
    await read.mapAsync(GPUMapMode.READ);
    try {
      return take(new Float32Array(read.getMappedRange()));
    } finally {
      read.unmap();
      drawing.unused.push(read);
    }
  }

  /** Frees what frames of a view were drawn into; none of them may be on its way. */
  async freeView(view: number): Promise<void> {
    const drawing = await this.#drawings.get(view)?.catch(() => undefined);
    this.#drawings.delete(view);
    for (const buffer of [...(drawing?.own ?? []), ...(drawing?.unused ?? [])]) buffer.destroy();
  }

  #upload(): void {
    if (this.#blocks > this.device.limits.maxComputeWorkgroupsPerDimension) throw new Error(`${this.scene.count} Gaussians are too many for the GPU`);
    for (const values of [this.scene.gaussians, this.scene.harmonics]) {
      const buffer = this.#storage("the scene", values.byteLength);
      this.device.queue.writeBuffer(buffer, 0, values);
      this.#scene.push(buffer);
    }
    for (const bytes of [BLOCK * SLICE_BYTES, BLOCK * EXTENT_BYTES, BOUNDS_BYTES]) this.#scene.push(this.#storage("the scene", this.#blocks * bytes));
  }

  async #draws(plan: Plan): Promise<Drawing> {
    const { fanned, wrap, height, width } = plan;
    const pipelines = await this.#compiled(fanned, wrap, Number(plan.beam[0]! > 0));
    const [gaussians, harmonics, slices, extents, bounds] = this.#scene as [GPUBuffer, GPUBuffer, GPUBuffer, GPUBuffer, GPUBuffer];
    const tiles = [Math.ceil(width / TILE), Math.ceil(height / TILE)] as [number, number];
    const of = `planes of ${height}x${width} pixels`;
    return this.#checked(() => {
      const view = this.device.createBuffer({ size: VIEW_BYTES, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
      const table = anglesOf(plan);
      const angles = this.#storage(of, table.byteLength);
      this.device.queue.writeBuffer(angles, 0, table);
      const sums = this.#storage(of, 12 * height * width);
      const steps = this.#storage(of, 4 * tiles[1] * width);
      const planes = this.#storage(of, 4 * wantedPlanes(plan).filter(Boolean).length * height * width);
      const bound = [
        [view, gaussians, harmonics, angles, slices, extents, bounds],
        [view, slices, extents, bounds, angles, sums, steps],
        [view, sums, steps, planes],
      ];
      const groups: [number, number][] = [[this.#blocks, 1], tiles, [Math.ceil(width / FINISH_COLUMNS), tiles[1]]];
      const passes = pipelines.map((pipeline, at) => {
        const entries = bound[at]!.map((buffer, binding) => ({ binding, resource: { buffer } }));
        return { pipeline, bindings: this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries }), groups: groups[at]! };
      });
      return { view, planes, own: [view, angles, sums, steps, planes], passes, unused: [] };
    });
  }

  /** The passes for scan lines and a slice of some kind, which views share. */
  #compiled(FANNED: number, WRAP: number, THICK: number): Promise<GPUComputePipeline[]> {
    return kept(this.#pipelines, `${FANNED}${WRAP}${THICK}`, () => {
      const compile = (code: string, constants: Record<string, number>): Promise<GPUComputePipeline> =>
        this.device.createComputePipelineAsync({ layout: "auto", compute: { module: this.device.createShaderModule({ code: common + code }), constants } });
      const cut = compile(slice, { FANNED, WRAP, THICK, SIGMOID: Number(this.scene.sigmoid), DEGREE: this.scene.degree });
      return Promise.all([cut, compile(draw, { FANNED, WRAP }), compile(finish, { FANNED, WRAP })]);
    });
  }

  /** The struct View of common.wgsl. */
  #view(plan: Plan): ArrayBuffer {
    const { axes, origin, near_cm, row_cm, most_cm, start, span, beam, height, width } = plan;
    const bytes = new ArrayBuffer(VIEW_BYTES);
    const [a, b, c, d, e, f, g, h, i] = axes as [number, number, number, number, number, number, number, number, number];
    const volume = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
    const rounded = origin.map(Math.fround);
    const rest = origin.map((value, at) => value - rounded[at]!);
    const numbers = [a, b, c, near_cm, d, e, f, row_cm, g, h, i, most_cm, ...rounded, start, ...rest, span / width, ...beam];
    new Float32Array(bytes).set(numbers.map((value) => Math.min(value, FAR)));
    let place = 0;
    new Int32Array(bytes, 4 * numbers.length).set(wantedPlanes(plan).map((wanted) => (wanted ? place++ : -1)));
    new Float32Array(bytes, 112)[0] = volume;
    new Int32Array(bytes, 116).set([this.scene.count, height, width]);
    return bytes;
  }

  #storage(what: string, bytes: number): GPUBuffer {
    const most = Math.min(this.device.limits.maxStorageBufferBindingSize, this.device.limits.maxBufferSize);
    if (bytes > most) throw new Error(`${what} would take ${bytes} bytes at once, and the GPU gives at most ${most}`);
    const usage = GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC | GPUBufferUsage.COPY_DST;
    return this.device.createBuffer({ size: Math.max(bytes, SLICE_BYTES), usage });
  }

  /** What `make` returns. Throws where the memory of the GPU does not suffice for it. */
  async #checked<Result>(make: () => Result): Promise<Result> {
    this.device.pushErrorScope("out-of-memory");
    let made;
    try {
      made = make();
    } finally {
      const error = await this.device.popErrorScope();
      if (error) throw new Error(`the memory of the GPU does not suffice: ${error.message}`);
    }
    return made;
  }
}

/** What the browser answers about its GPU; undefined where it does not, as one whose process for graphics hangs. */
async function answered<Answer>(answer: Promise<Answer> | undefined): Promise<Answer | undefined> {
  let timer;
  const late = new Promise<undefined>((resolve) => (timer = setTimeout(resolve, MOST_WAIT_MS)));
  try {
    return await Promise.race([answer, late]);
  } finally {
    clearTimeout(timer);
  }
}

/** What a map has at a key: what `make` returns, where there was nothing. */
function kept<Key, Value>(map: Map<Key, Value>, key: Key, make: () => Value): Value {
  if (!map.has(key)) map.set(key, make());
  return map.get(key)!;
}

/** [2, W, 2]: sine and cosine of each scan line's angle; sine, and 1 - cosine to the last digit, of so many times the pitch. */
function anglesOf({ start, span, width }: Plan): Float32Array<ArrayBuffer> {
  const [table, pitch] = [new Float32Array(4 * width), span / width];
  for (let line = 0; line < width; line++) {
    const [angle, turn] = [start + pitch * (line + 0.5), pitch * line];
    table.set([Math.sin(angle), Math.cos(angle)], 2 * line);
    table.set([Math.sin(turn), 2 * Math.sin(turn / 2) ** 2], 2 * (width + line));
  }
  return table;
}

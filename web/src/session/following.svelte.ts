/** Another program's stream, shown in place of the page's own: its frames, its poses, its probe. */

import { WatchStream, type StreamSummary } from "../api/streams";
import type { Frame, FrameHeader, Refusal, StreamSettings } from "../api/stream";
import type { Pose } from "../geometry/pose";
import type { Session } from "./session.svelte";

export interface FollowEvents {
  /** A frame as the program got it. */
  frame(frame: Frame): void;
  /** A frame whose pixels no page can show: the same is to be rendered for the page. */
  render(pose: Pose, settings: StreamSettings): void;
  refused(refusal: Refusal): void;
  ended(): void;
}

export class Following {
  /** Whether the connection was lost, and is tried again: what is shown is old. */
  lost = $state(false);
  /** Whether the frames are rendered for the page. */
  renderedHere = $state(false);
  /** The scene that the program asks for in place of this one. */
  otherScene = $state<string | null>(null);
  #pose: Pose | null = null;
  #choosing = false;
  #watch: WatchStream;

  constructor(
    readonly stream: StreamSummary,
    private readonly session: Session,
    private readonly events: FollowEvents,
  ) {
    this.#watch = new WatchStream(stream.id, {
      frame: (frame) => this.#take(frame),
      refused: (refusal) => this.events.refused(refusal),
      connected: (yes) => (this.lost = !yes),
      ended: () => this.events.ended(),
    });
  }

  close(): void {
    this.#watch.close();
  }

  /** Whether the probe was moved since by somebody else than the program. An image that stands moves nothing. */
  wasSteered(pose: Pose): boolean {
    if (this.session.frozen) this.#pose = null; // the first frame after that places the probe again
    return !this.#choosing && this.#pose !== null && pose !== this.#pose;
  }

  /** Puts the probe where the frame on the screen has it, unless the image stands. */
  shown({ header }: Frame): void {
    if (this.otherScene !== null || this.session.frozen) return;
    this.#place(header.pose.flat());
    if (sameProbe(header.probe, this.session.probe) || this.#choosing) return;
    this.#choosing = true;
    const chosen = sameProbe(header.probe, this.session.scene.own.probe) ? null : header.probe;
    void this.session
      .chooseProbe(chosen)
      .catch(() => undefined)
      .finally(() => {
        if (this.#pose !== null) this.#place(this.#pose);
        this.#choosing = false;
      });
  }

  #place(pose: Pose): void {
    this.session.pose = this.#pose = pose;
  }

  #take(frame: Frame): void {
    const { header } = frame;
    this.otherScene = header.scene === this.session.name ? null : header.scene;
    if (this.otherScene !== null) return;
    this.renderedHere = !isShowable(frame);
    if (this.renderedHere) this.events.render(header.pose.flat(), settingsOf(header));
    else this.events.frame(frame);
  }
}

function isShowable({ header, pixels }: Frame): boolean {
  const bytes = header.height * header.width * header.outputs.length;
  return header.encoding === "uint8" && header.outputs.includes("bmode") && pixels.length >= bytes;
}

/** What renders a frame again, as B-mode. */
function settingsOf(header: FrameHeader): StreamSettings {
  const { rendered_height, rendered_width, probe, display, slice_thickness_mm, contact, tools, ghost } = header;
  return {
    height: rendered_height,
    width: rendered_width,
    probe,
    display,
    outputs: ["bmode"],
    slice_thickness_mm,
    contact,
    tools,
    ghost,
    min_confidence: null,
    below_min_confidence: "mask",
    registration: null, // the poses that are told lead into the scene
  };
}

function sameProbe(a: object, b: object): boolean {
  const sorted = (probe: object): string => JSON.stringify(Object.entries(probe).sort());
  return sorted(a) === sorted(b);
}

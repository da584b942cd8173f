/** How far the image along the poses that are played can be trusted: asked for once, without rendering. */

import { assessPoses, type Extrapolation } from "../api/assess";
import { between } from "../geometry/pose";
import { service } from "../shell/service.svelte";
import type { Session } from "./session.svelte";

const MOST_PLACES = 160;
const MOST_BETWEEN = 4; // places from one pose to the next
const SETTLED_MS = 250; // after the last change of what is played

export class SweepConfidence {
  /** At even distances from the first pose to the last; empty until it is known. */
  along = $state.raw<Extrapolation[]>([]);

  /** Must be made while a component is being made. */
  constructor(session: Session) {
    $effect(() => {
      const { track, chosenProbe, scene } = session;
      if (!scene.known || track.length < 2 || service.status !== "ready") return;
      const count = Math.min(MOST_PLACES, (track.length - 1) * MOST_BETWEEN + 1);
      const poses = Array.from({ length: count }, (_, index) => {
        const place = (index / (count - 1)) * (track.length - 1);
        const before = Math.floor(place);
        return session.held(between(track[before]!, track[Math.min(before + 1, track.length - 1)]!, place - before));
      });
      let gone = false;
      const timer = setTimeout(() => {
        assessPoses(session.name, poses, chosenProbe).then(
          (found) => {
            if (!gone) this.along = found;
          },
          () => undefined, // the slider does without it
        );
      }, SETTLED_MS);
      return () => {
        gone = true;
        clearTimeout(timer);
        this.along = [];
      };
    });
  }
}

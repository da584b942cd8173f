/** A picture of the service that follows its address; the one before stays, told to be old, until it is there. */

import { explain, untilAnswered } from "../api/client";
import { readGrey, type Grey } from "./picture";

export class LoadedPicture {
  picture = $state.raw<Grey | null>(null);
  problem = $state<string | null>(null);
  stale = $state(true);

  /** Follows `path`; null: there is none yet. Must be made while a component is being made; ends with it. */
  constructor(path: () => string | null) {
    $effect(() => {
      const wanted = path();
      this.stale = true;
      if (wanted === null) return;
      const ending = new AbortController();
      const tell = (error: unknown): void => {
        if (ending.signal.aborted) return;
        this.picture = null;
        this.problem = explain(error);
      };
      untilAnswered(() => readGrey(wanted, ending.signal), tell, ending.signal)
        .then((picture) => {
          if (ending.signal.aborted) return;
          this.picture = picture;
          this.problem = null;
          this.stale = false;
        })
        .catch(tell);
      return () => ending.abort();
    });
  }
}

/** The sweep that is chosen and sent in Train. */

import { uploadDataset, type DatasetOptions } from "../api/datasets";
import { nameOfFile } from "../shared/text";
import { Sending } from "../shared/sending.svelte";
import { datasets } from "./datasets.svelte";

class SweepUpload extends Sending {
  files = $state.raw<File[]>([]);
  name = $state("");
  isPrivate = $state(false);
  options = $state<DatasetOptions>({});

  choose(files: File[]): void {
    this.files = files;
    this.problem = null;
    const named = files.find((file) => !/\.xml$/i.test(file.name)) ?? files[0];
    if (named) this.name = nameOfFile(named.name) || "sweep";
  }

  /** Lets go of the files and of what was entered for them. */
  discard(): void {
    this.files = [];
    this.options = {};
    this.isPrivate = false;
  }

  /** Sends the files; what comes of them is the dataset that is looked at. */
  async send(): Promise<void> {
    const dataset = await this.transfer((told, signal) =>
      uploadDataset(this.name, this.files, { ...this.options }, this.isPrivate, told, signal),
    );
    if (dataset === null) return;
    this.discard();
    await datasets.refresh();
    datasets.chosen = dataset.name;
  }
}

export const sweepUpload = new SweepUpload();

/** Light or dark: as the system has it until the person says otherwise. */

import { MediaQuery } from "svelte/reactivity";

const STORAGE = "ultragray.theme";
export const THEMES = ["system", "light", "dark"] as const;
/** What a person chooses. */
type ThemeChoice = (typeof THEMES)[number];

class ThemeState {
  chosen = $state<ThemeChoice>(THEMES.find((one) => one === localStorage.getItem(STORAGE)) ?? "system");
  #systemDark = new MediaQuery("(prefers-color-scheme: dark)");

  constructor() {
    $effect.root(() => {
      $effect.pre(() => {
        const system = this.#systemDark.current ? "dark" : "light";
        document.documentElement.dataset.theme = this.chosen === "system" ? system : this.chosen;
      });
    });
  }

  choose(choice: ThemeChoice): void {
    this.chosen = choice;
    localStorage.setItem(STORAGE, choice);
  }
}

export const theme = new ThemeState();

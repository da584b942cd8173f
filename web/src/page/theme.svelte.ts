/** Light or dark: as the system has it until the person says otherwise. */

const STORAGE = "ultragray.theme";
export const THEMES = ["system", "light", "dark"] as const;
/** What a person chooses. */
export type ThemeChoice = (typeof THEMES)[number];

const systemDark = matchMedia("(prefers-color-scheme: dark)");

class ThemeState {
  chosen = $state<ThemeChoice>(stored());
  #system = $state<"light" | "dark">(systemDark.matches ? "dark" : "light");

  constructor() {
    systemDark.addEventListener("change", (event) => {
      this.#system = event.matches ? "dark" : "light";
      this.#apply();
    });
    this.#apply();
  }

  get current(): "light" | "dark" {
    return this.chosen === "system" ? this.#system : this.chosen;
  }

  choose(choice: ThemeChoice): void {
    this.chosen = choice;
    localStorage.setItem(STORAGE, choice);
    this.#apply();
  }

  #apply(): void {
    document.documentElement.dataset.theme = this.current;
  }
}

function stored(): ThemeChoice {
  return THEMES.find((one) => one === localStorage.getItem(STORAGE)) ?? "system";
}

export const theme = new ThemeState();

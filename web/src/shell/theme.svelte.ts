/** Light or dark: as the system has it until the switch says otherwise. */

const STORAGE = "ultragray.theme";
export type Theme = "light" | "dark";

const systemDark = matchMedia("(prefers-color-scheme: dark)");

class ThemeState {
  #chosen = $state<Theme | null>(stored());
  #system = $state<Theme>(systemDark.matches ? "dark" : "light");

  constructor() {
    systemDark.addEventListener("change", (event) => {
      this.#system = event.matches ? "dark" : "light";
      this.#apply();
    });
    this.#apply();
  }

  get current(): Theme {
    return this.#chosen ?? this.#system;
  }

  toggle(): void {
    this.#chosen = this.current === "dark" ? "light" : "dark";
    localStorage.setItem(STORAGE, this.#chosen);
    this.#apply();
  }

  #apply(): void {
    document.documentElement.dataset.theme = this.current;
  }
}

function stored(): Theme | null {
  const value = localStorage.getItem(STORAGE);
  return value === "light" || value === "dark" ? value : null;
}

export const theme = new ThemeState();

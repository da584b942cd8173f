/** What the console says, in the language of the person: `words.scan.freeze`, from the catalogue in `en` or `de`. */

import { english, type Words } from "./en/english";
import { translated } from "./translated";

/** Each in its own name, as the choice of the language writes it. */
export const LANGUAGES = { en: "English", de: "Deutsch" } as const;
export type LanguageName = keyof typeof LANGUAGES;

const STORAGE = "ultragray.language";
const CATALOGUES: Record<LanguageName, () => Promise<Words>> = {
  en: async () => english,
  de: async () => translated(english, (await import("./de/german")).german),
};

class Language {
  current = $state<LanguageName>("en");
  catalogue = $state.raw<Words>(english);

  constructor() {
    void this.#take(wanted()).catch(() => undefined); // English stays where the other cannot be loaded
  }

  /** Takes a language and remembers it. Throws where its catalogue cannot be loaded. */
  async choose(name: LanguageName): Promise<void> {
    await this.#take(name);
    localStorage.setItem(STORAGE, name);
  }

  async #take(name: LanguageName): Promise<void> {
    this.catalogue = await CATALOGUES[name]();
    this.current = name;
    document.documentElement.lang = name;
  }
}

/** The language that was chosen here, else the first of the browser's that the console speaks. */
function wanted(): LanguageName {
  const names = [localStorage.getItem(STORAGE) ?? "", ...navigator.languages.map((tag) => tag.slice(0, 2).toLowerCase())];
  return (names.find((name) => name in LANGUAGES) as LanguageName | undefined) ?? "en";
}

export const language = new Language();

/** Read in a template or a derived value, it follows the language. */
export const words: Words = new Proxy(english, { get: (_, area) => language.catalogue[area as keyof Words] });

/** scenes: what it says in English. */

export const scenes = {};

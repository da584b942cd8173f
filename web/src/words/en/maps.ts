/** maps: what it says in English. */

export const maps = {};

/** space: what it says in English. */

export const space = {};

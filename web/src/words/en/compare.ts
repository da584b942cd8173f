/** compare: what it says in English. */

export const compare = {};

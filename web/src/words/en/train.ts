/** train: what it says in English. */

export const train = {};

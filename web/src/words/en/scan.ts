/** scan: what it says in English. */

export const scan = {};

/** shared: what it says in English. */

export const shared = {};

/** session: what it says in English. */

export const session = {};

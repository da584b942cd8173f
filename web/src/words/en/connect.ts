/** connect: what it says in English. */

export const connect = {};

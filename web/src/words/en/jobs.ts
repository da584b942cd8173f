/** jobs: what it says in English. */

export const jobs = {};

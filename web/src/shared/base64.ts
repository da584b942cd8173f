/** Bytes as text, as JSON carries them. */

const PIECE = 0x8000; // of the arguments that a function takes

export function base64(bytes: Uint8Array): string {
  const pieces: string[] = [];
  for (let start = 0; start < bytes.length; start += PIECE) pieces.push(String.fromCharCode(...bytes.subarray(start, start + PIECE)));
  return btoa(pieces.join(""));
}

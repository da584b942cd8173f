/** Files that the page made, for the person to keep. */

const KEPT_MS = 60_000;

/** Gives a file to the person. */
export function saveBlob(blob: Blob, name: string): void {
  const address = URL.createObjectURL(blob);
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), KEPT_MS); // some browsers read it after the click
}

/** space: what it says in English. */


const viewpoints: Record<Viewpoint, string> = { whole: "Whole", behind: "Behind", side: "Side", top: "Top" };
const forms: Record<Form, string> = {
  shaded: "Shaded volume",
  maximum: "Brightest of volume",
  splats: "Splats",
  none: "Nothing",
};
const colours: Record<ColourBy, string> = {
  label: "Label",
  intensity: "Intensity",
  transmittance: "Transmittance",
  coverage: "Coverage",
};
const solids: Record<SolidBy, string> = { echo: "Bright echo", shadow: "Casts shadow" };
const cuts: Record<CutAcross, string> = {
  none: "Uncut",
  image: "At the image",
  lateral: "Across lateral, with the probe",
  elevation: "Across elevation, with the probe",
  axial: "Across depth, with the probe",
  x: "Across x of the scene",
  y: "Across y of the scene",
  z: "Across z of the scene",
};

export const space = {
  label: "Scene in space: arrow keys turn the view, + and − zoom",
  loading: "Loading the 3D view …",
  noWebGl: "The 3D view needs WebGL, which this browser does not offer. Everything else works without it.",
  dragging: "Dragging the probe",
  move: "Move",
  turn: "Turn",
  contact: "Contact",
  contactMeaning: "The face of the probe stays on the skin. Moving it along its axis presses.",
  pressed: (depth_mm: number): string => `pressed ${depth_mm.toFixed(1)} mm`,
  noSkin: "The views of this scene look in many directions: there is no skin to stay on.",
  options: "Options",
  viewpoint: "Look from",
  viewpoints,
  form: "Show",
  forms,
  colour: "Colour",
  colours,
  solid: "Opaque",
  solids,
  threshold: "From",
  thresholdMeaning: "Opaque from",
  opacity: "Opacity",
  size: "Size",
  sizeMeaning: "Size of splats",
  cut: "Cut",
  cuts,
  cutAt: "At",
  sweep: "Sweep",
  skin: "Skin",
  help: "Drag the probe by its body over the skin; double-click the skin to put it there.",
  legend: "Colours",
  toggleLabel: "Show or leave out",
  building: "refining …",
};

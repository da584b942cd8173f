import { mount } from "svelte";

import App from "./shell/App.svelte";
import "./styles.css";

mount(App, { target: document.getElementById("app")! });

// Dark or light: as the system has it, until the button says otherwise. Listeners redraw what CSS cannot colour.

const themeListeners = [];
const darkSystem = matchMedia("(prefers-color-scheme: dark)");

const isDark = () => (document.documentElement.style.colorScheme || (darkSystem.matches ? "dark" : "light")) === "dark";

const tellTheme = () => {
  byId("theme").textContent = isDark() ? "Light colours" : "Dark colours";
  themeListeners.forEach((listener) => listener());
};

byId("theme").addEventListener("click", () => {
  document.documentElement.style.colorScheme = isDark() ? "light" : "dark";
  tellTheme();
});
darkSystem.addEventListener("change", tellTheme);
tellTheme();

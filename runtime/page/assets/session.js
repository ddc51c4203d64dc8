// The browser stores the token only for this address and port, so it is not sent to any other server.
const key = new URL(location.href).searchParams.get("token");
if (key) {
  localStorage.setItem("token", key);
  history.replaceState(null, "", location.pathname);
}
export const token = () => localStorage.getItem("token") ?? "";
export const keep = (text) => localStorage.setItem("token", text);
export const ask = (path, options = {}) =>
  fetch(path, { ...options, headers: { ...options.headers, Authorization: `Bearer ${token()}` } });
